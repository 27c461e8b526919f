"""What a stranger's package changes in the process is put back and told, and what is no result of it is an error.

Installed distributions as in tests/test_hostile_plugins.py, through the command `sw`.
"""

from __future__ import annotations

import json
from pathlib import Path

import forked_children
import pytest
from bad_neighbours import metric
from reckless_neighbours import (
    BROKEN,
    CHANGING,
    FAMILIES,
    IMPORTS,
    METRICS,
    RASTERIZERS,
    TARGETS,
    TRAINED,
    family,
    lazy_metric,
    rasterizer,
)
from strangers_site import Listed, Site

pytestmark = pytest.mark.pipeline


def lines_about(name: str, text: str) -> list[str]:
    return [line for line in text.splitlines() if f"{name} 0.1" in line]


# ------------------------------------------------------------------------------------------- while they register


@pytest.fixture(scope="module")
def listing(tmp_path_factory: pytest.TempPathFactory):
    """`sw list-plugins --json` beside all that register recklessly, which imports no torch."""
    site = Site(tmp_path_factory.mktemp("street"))
    for name, (source, _) in {**IMPORTS, **BROKEN}.items():
        good = metric(f"of-{name}", name.replace("-", "_")) if name in IMPORTS else ""
        site.install(name, f"{source}\n{good}")
    with forked_children.starting():
        done = site.sw("list-plugins", "--json")
    return done, Listed(json.loads(done.stdout))


@pytest.mark.parametrize("name", IMPORTS)
def test_what_registering_changes_is_put_back_and_told_once(listing, name):
    done, listed = listing
    (line,) = lines_about(name, done.stderr)
    assert IMPORTS[name][1] in line
    assert listed.of(name)["error"] is None
    assert [each["name"] for each in listed.of(name)["provides"]] == [f"of-{name}"]


@pytest.mark.parametrize("name", BROKEN)
def test_one_that_does_not_come_back_from_registering_is_broken(listing, name):
    _, listed = listing
    assert BROKEN[name][1] in listed.of(name)["error"]


def test_stdout_holds_the_json_alone(listing):
    """And waiting has ended: one would sleep for longer than a command may take, one for ever."""
    done, _ = listing
    assert "rubbish" in done.stderr


def test_half_an_import_of_another_package_is_waited_for(tmp_path):
    """Else nobody could import it any more: torch takes its time on a slow disk."""
    site = Site(tmp_path)
    site.install(
        "sw-heavy", "import their_torch\n" + metric("heavy", "sw_heavy"), their_torch="import time\ntime.sleep(4)\n"
    )
    done = site.sw("list-plugins", "--json")
    assert Listed(json.loads(done.stdout)).working["sw-heavy"] == {"metric heavy"}
    assert "sw-heavy 0.1 is being imported for 3 s" in done.stderr


# ------------------------------------------------------------------------------------------ metrics, in a training


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory: pytest.TempPathFactory):
    """`sw run --json` beside metrics that change torch when they are imported, and others when they measure."""
    site = Site(tmp_path_factory.mktemp("metrics"))
    for name, (body, _) in TARGETS.items():
        target = {f"{name.replace('-', '_')}_target": f"import torch\n{body}\ndef value(render, truth): return 1.0\n"}
        site.install(name, lazy_metric(name), **target)
    for name, (body, _) in {**METRICS, **CHANGING}.items():
        site.install(name, metric(name.removeprefix("sw-"), name.replace("-", "_"), body))
    site.install("sw-sleeps", BROKEN["sw-sleeps"][0])
    run = ("run", "--scene", "demo:tiny", "--set", "iterations=4", "--set", "eval_every=2", "--out", "out")
    return site.sw(*run, "--json")


@pytest.mark.parametrize("name", [*TARGETS, *CHANGING])
def test_the_state_of_torch_is_put_back_and_its_metric_named(evaluated, name):
    (record,) = (run["record"] for run in json.loads(evaluated.stdout)["runs"])
    assert record["metrics"][name.removeprefix("sw-")]["mean"] == 1.0
    said = {**TARGETS, **CHANGING}[name][1]
    assert [line for line in lines_about(name, evaluated.stderr) if said in line]


def test_the_processes_of_a_run_wait_once_for_one_that_does_not_come_back(evaluated):
    assert len(lines_about("sw-sleeps", evaluated.stderr)) == 1


@pytest.mark.parametrize("name", METRICS)
def test_a_metric_that_would_end_the_process_has_no_value(evaluated, name):
    (record,) = (run["record"] for run in json.loads(evaluated.stdout)["runs"])
    assert METRICS[name][1] in record["unknown"][f"metrics.{name.removeprefix('sw-')}.mean"]


# --------------------------------------------------------------------------------- scenes, pictures, other exits


METHOD = """
@hookimpl
def register_methods(registry):
    registry.add("leaves", "sw_leaves_method:Leaves", summary="")
    registry.add("slow", "sw_slow_target:Slow", summary="")

from splatwizard_core.api import Method

class Leaves(Method):
    name = "leaves"
    def stages(self):
        import os
        os._exit(0)
"""
TARGET = """
import time
from splatwizard_core.api import Method

time.sleep(3.5)

class Slow(Method):
    name = "slow"
"""
RENDER = "render scene.swz --scene demo:tiny --set raster.prefer=['{}'] --out pictures-{}"
TRAIN = "train --method 3dgs --scene demo:tiny --set iterations=2 --set raster.prefer=['{}'] --out out-{}"


@pytest.fixture(scope="module")
def commands(tmp_path_factory: pytest.TempPathFactory):
    """What each command did, by its words."""
    site = Site(tmp_path_factory.mktemp("others"))
    golden = Path(__file__).parent / "golden" / "3dgs_r3_v1.swz"
    (site.folder / "scene.swz").write_bytes(golden.read_bytes())
    for name, (body, _) in {**RASTERIZERS, **TRAINED}.items():
        site.install(name, rasterizer(name, body))
    site.install("sw-leaves-method", METHOD, sw_slow_target=TARGET)
    words = [RENDER.format(*[name.removeprefix("sw-")] * 2) for name in RASTERIZERS]
    words += [TRAIN.format(*[name.removeprefix("sw-")] * 2) for name in TRAINED]
    words += ["schedule leaves", "schedule slow"]
    return dict(zip(words, site.sw_each([each.split() for each in words]), strict=True))


@pytest.mark.parametrize("name", [*RASTERIZERS, *TRAINED])
def test_a_picture_that_is_none_is_an_error_that_names_its_rasterizer(commands, name):
    words = RENDER if name in RASTERIZERS else TRAIN
    done = commands[words.format(*[name.removeprefix("sw-")] * 2)]
    (line,) = (line for line in done.stderr.splitlines() if line.startswith("error: "))
    assert f"rasterizer '{name.removeprefix('sw-')}' of {name} 0.1" in line
    assert {**RASTERIZERS, **TRAINED}[name][1] in line
    assert done.status == 2


def test_a_step_that_ends_the_process_is_a_failure_by_name(commands):
    done = commands["schedule leaves"]
    assert "ProcessExit: os._exit(0) (in sw-leaves-method 0.1)" in done.stderr
    assert done.status == 1


def test_a_target_whose_import_takes_its_time_is_named(commands):
    assert "method 'slow' of sw-leaves-method 0.1 is being imported for 3 s" in commands["schedule slow"].stderr


@pytest.fixture(scope="module")
def families(tmp_path_factory: pytest.TempPathFactory):
    """What `sw info` says of a folder of ours, beside each family that claims it."""
    found = {}
    for name, (load, _) in FAMILIES.items():
        site = Site(tmp_path_factory.mktemp(name))
        site.install(name, family(name, load))
        words = ["data synth photos --size tiny", "info photos --json", f"info {name.removeprefix('sw-')}:photos"]
        found[name] = site.sw_each([each.split() for each in words])[1:]
    return found


@pytest.mark.parametrize("name", FAMILIES)
def test_a_family_that_claims_everything_and_loads_nothing_is_passed_over(families, name):
    found, named = families[name]
    assert json.loads(found.stdout)["name"] == "photos"
    (line,) = lines_about(name, found.stderr)
    assert FAMILIES[name][1] in line
    assert "it is read as 'colmap'" in line
    assert named.status == 2
    assert FAMILIES[name][1] in named.stderr
