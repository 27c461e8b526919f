"""A plugin can only hurt itself: bad neighbours as installed distributions, all at once, through the command `sw`.

Each case has the distribution of its own, and one line that names it; everything else lists, runs and renders.
"""

from __future__ import annotations

import json
import re
from typing import Any

import pytest
from advice import as_written
from bad_neighbours import BROKEN, DETECTS, METRICS, REFUSED, metric, move_in
from strangers_site import Done, Listed, Site

pytestmark = pytest.mark.pipeline


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Site:
    """All bad neighbours, installed."""
    site = Site(tmp_path_factory.mktemp("street"))
    move_in(site)
    return site


@pytest.fixture(scope="module")
def listed(street: Site) -> Listed:
    return street.listed()


@pytest.fixture(scope="module")
def ours(tmp_path_factory: pytest.TempPathFactory) -> Listed:
    """What is there without them."""
    site = Site(tmp_path_factory.mktemp("nobody"))
    return site.listed()


def test_everybody_else_is_listed_with_all_that_they_provide(listed, ours):
    assert {name: listed.working.get(name) for name in ours.working} == ours.working
    assert listed.working["sw-good"] == {"metric good"}
    assert listed.content["clashes"] == ours.content["clashes"]


@pytest.mark.parametrize("name", BROKEN)
def test_one_that_cannot_be_loaded_is_broken_in_one_line_and_leaves_nothing(listed, name):
    row = listed.of(name)
    assert BROKEN[name][1] in row["error"]
    assert "\n" not in row["error"]
    assert row["provides"] == []


@pytest.mark.parametrize("name", REFUSED)
def test_an_entry_that_is_ours_or_not_legal_is_refused_and_no_other(listed, name):
    _, entry, why = REFUSED[name]
    row = listed.of(name)
    assert row["error"] is None
    (refused,) = row["refused"]
    assert f"{refused['kind']} '{refused['name']}'" == entry
    assert why in refused["reason"]
    assert row["provides"] == []


def test_an_entry_point_called_like_ours_breaks_its_own_plugin(listed):
    assert (
        "its entry point is called 'core', which is the name of splatwizard-core" in listed.of("sw-core-thief")["error"]
    )
    assert "its entry point is called '3dgs', which is the name of sw-3dgs" in listed.of("sw-key-thief")["error"]


def test_two_strangers_with_one_entry_point_are_both_told_of_the_other(listed):
    errors = [listed.of(name)["error"] for name in ("sw-twin-a", "sw-twin-b")]
    assert errors == [
        f"its entry point is called 'twin', which is the name of {other}: uninstall one of them"
        for other in ("sw-twin-b", "sw-twin-a")
    ]


def test_requirements_that_are_not_met_break_a_plugin_with_the_cure(listed):
    assert re.fullmatch(
        r"needs splatwizard-core>=9, but \S+ is installed: pip install 'splatwizard-core>=9'",
        listed.of("sw-future")["error"],
    )
    assert "pip install no-such-distribution-here" in listed.of("sw-needy")["error"]


def test_one_without_readable_metadata_is_a_plugin_of_nobody_we_know(listed):
    for key, name in (("sw-3dgs", "metric nameless"), ("binary", "metric binary")):
        assert listed.working[f"{key} (without metadata)"] == {name}


def test_the_text_names_each_culprit_in_its_own_row(street):
    done = street.sw("list-plugins")
    words = " ".join(done.stdout.replace("│", " ").split())
    assert "refused: metric 'psnr': that is a name of splatwizard-core" in words
    assert "NOISE" not in done.stdout
    assert "broken: SystemExit: needs a licence" in words


def test_sw_plugins_keeps_out_whatever_it_does_not_name(street):
    assert street.listed(SW_PLUGINS="").names == {"splatwizard-core"}
    chosen = street.listed(SW_PLUGINS="good,sw-twin-a")
    assert chosen.names == {"splatwizard-core", "sw-good", "sw-twin-a"}
    assert chosen.working["sw-twin-a"] == {"metric twin-a"}  # its twin is not there


@pytest.mark.parametrize("arguments", [("--help",), ("--version",)])
def test_help_is_help(street, arguments):
    done = street.sw(*arguments)
    assert "NOISE" not in done.stdout
    if arguments == ("--help",):
        assert "exits-three" in done.stdout


# ------------------------------------------------------------------------------------------------- one run


@pytest.fixture(scope="module")
def run(street: Site):
    """`sw run --json` of our default method on a scene of ours, beside all of them."""
    return street.sw("run", "--scene", "demo:tiny", "--set", "iterations=2", "--out", "out", "--json")


@pytest.fixture(scope="module")
def record(run):
    (only,) = json.loads(run.stdout)["runs"]
    return only["record"]


def test_a_run_of_ours_prints_nothing_but_its_json(run, record):
    assert record["method"] == "3dgs"
    for noise in ("at import", "of a hook", "of a target", "after a run"):
        assert f"NOISE {noise}" in run.stderr


@pytest.mark.parametrize("name", METRICS)
def test_a_metric_that_fails_has_a_reason_and_the_others_their_values(record, name):
    reason = record["unknown"][f"metrics.{name.removeprefix('sw-')}.mean"]
    assert f"of {name} 0.1 failed" in reason
    assert METRICS[name][1] in reason


def test_the_other_metrics_have_the_values_that_they_have_alone(record):
    alone = {name: metric["mean"] for name, metric in record["metrics"].items() if name in ("psnr", "ssim", "l1")}
    assert record["metrics"]["good"]["mean"] == 1.0
    assert 5 < alone["psnr"] < 60  # of black images against black ones it is infinite
    assert 0 < alone["l1"] < 0.5


def test_a_rasterizer_of_a_stranger_draws_for_nobody_who_did_not_ask(run, record):
    drawn = {
        part["name"] for phase in record["phases"] for part in phase["provided_by"] if part["kind"] == "rasterizer"
    }
    assert drawn
    assert not drawn & {"boaster", "lightning", "exits", "lies"}
    assert "sw_no_kernels" not in run.stderr  # modules are loaded where they are used


def test_hooks_around_a_run_fail_alone(run):
    told = [line for line in run.stderr.splitlines() if "sw-hooks" in line]
    assert any("run_finished failed: SystemExit: 0" in line for line in told)


# ------------------------------------------------------------------------------ many commands in one process


@pytest.fixture(scope="module")
def commands(street: Site, run) -> dict[str, Done]:
    """What each of COMMANDS did."""
    (encoded,) = street.folder.glob("out/**/scene.swz")
    (street.folder / "scene.swz").write_bytes(encoded.read_bytes())
    return dict(zip(COMMANDS, street.sw_each([line.split() for line in COMMANDS]), strict=True))


RENDER = "render scene.swz --scene demo:tiny --set raster.prefer=['lightning','exits','lies'] --out pictures --json"
SYNTH, INFO, EXPORT = "data synth photos --size tiny", "info photos --json", "export scene.swz scene.ply --json"
FAILING = {
    "export scene.swz x.bin --format export-raises":
        (2, "exporter 'export-raises' of sw-methods 0.1 failed: ValueError: no such vertex"),
    "export scene.swz x.bin --format export-exits":
        (2, "exporter 'export-exits' of sw-methods 0.1 failed: SystemExit: 0"),
    "export scene.swz x.bin --format export-nothing":
        (2, "exporter 'export-nothing' of sw-methods 0.1 failed: RuntimeError: it wrote no x.bin"),
    "schedule misnamed": (2, "method 'misnamed' of sw-methods 0.1 is called '3dgs' by its class"),
    "schedule import-exits": (2, "method 'import-exits' of sw-methods 0.1 could not be loaded"),
    "schedule stages-exits": (1, "SystemExit: 0 (in sw-methods 0.1)"),
    "schedule stages-raises": (1, "no disk (in sw-methods 0.1)"),
    "command-breaks": (2, "command 'command-breaks' of sw-methods 0.1 could not be loaded"),
    "schedule future": (2, "no method is called 'future'"),
    "train --method task-raises --scene demo:tiny --set iterations=2 --out a":
        (1, "task 'bad task' (pre) failed at step 1: OSError: no disk (in sw-methods 0.1)"),
    "train --method task-exits --scene demo:tiny --set iterations=2 --out b":
        (1, "task 'bad task' (pre) failed at step 1: SystemExit: 0 (in sw-methods 0.1)"),
    "train --method pup-3dgs --init scene.ply --scene demo:tiny --set prune.pruner=prune-raises --out c":
        (1, "OSError: no disk (in sw-methods 0.1)"),
    "train --method pup-3dgs --init scene.ply --scene demo:tiny --set prune.pruner=prune-exits --out d":
        (1, "SystemExit: 0 (in sw-methods 0.1)"),
}  # fmt: skip
"""Command -> exit status, and a part of the line about it."""
COMMANDS = [SYNTH, INFO, RENDER, EXPORT, "exits-three", *FAILING]


def test_a_constructor_that_fails_is_passed_over_with_its_distribution(commands):
    done = commands[RENDER]
    assert done.status == 0, done.stderr
    assert json.loads(done.stdout)["files"]
    (warned,) = (line for line in done.stderr.splitlines() if "cannot be made" in line)
    assert (
        "rasterizer 'lightning' of sw-lightning 0.1 cannot be made: RuntimeError: no such GPU; rendering with" in warned
    )


def test_a_suffix_of_ours_stays_ours(commands):
    assert json.loads(commands[EXPORT].stdout)["format"] == "ply"


def test_a_folder_is_recognised_though_a_family_fails_or_boasts(commands):
    done = commands[INFO]
    assert json.loads(done.stdout)["name"] == "photos"
    for name, (_, why) in DETECTS.items():
        (line,) = (line for line in done.stderr.splitlines() if name in line)
        assert why in line
    assert [line for line in done.stderr.splitlines() if "sw-hooks" in line and "describe_scene" in line]


@pytest.mark.parametrize("command", FAILING)
def test_who_asks_for_a_broken_thing_reads_in_one_line_whose_it_is(commands, command):
    status, said = FAILING[command]
    done = commands[command]
    (line,) = (line for line in done.stderr.splitlines() if line.startswith("error: "))
    assert said in line
    assert done.status == status


def test_a_command_of_a_stranger_ends_with_the_status_that_it_likes(commands):
    done = commands["exits-three"]
    assert (done.status, done.stdout) == (3, "")
    assert "error" not in done.stderr


@pytest.fixture(scope="module")
def diagnosis(street: Site) -> dict[str, dict[str, Any]]:
    """`sw doctor` beside all of them, and one that ends the process of whoever imports what it provides."""
    street.install("sw-zz-crash", metric("crash", "sw_crash_now"), sw_crash_now="import os\nos.abort()\n")
    street.install("sw-lacks", metric("lacks", "sw_lacks_now"), sw_lacks_now="import no_such_library\n")
    done = street.sw("doctor", "--json")
    assert json.loads(done.stdout)["ok"] is True
    return {check["name"]: check for check in json.loads(done.stdout)["checks"]}


PULL = re.compile(r"git -C \S+ pull && pip install -e \S*splatwizard-core")
UPGRADE = "pip install --upgrade {0}  (or, to be without it: pip uninstall {0})"


@pytest.mark.parametrize(
    ("name", "said", "mend"),
    [
        ("sw-raises", "No module named 'no_such_library'", "pip install no_such_library"),
        ("sw-needy", "which is not installed", "pip install no-such-distribution-here"),
        ("sw-future", "needs splatwizard-core>=9", PULL),
        ("sw-exits", "needs a licence", UPGRADE.format("sw-exits")),
        ("sw-core-thief", "which is the name of splatwizard-core", "pip uninstall sw-core-thief"),
        ("sw-twin-a", "which is the name of sw-twin-b", "pip uninstall sw-twin-a"),
        ("metric psnr", "sw-claims-psnr 0.1 adds it in vain: that is a name of splatwizard-core",
         "pip uninstall sw-claims-psnr  (what else it provides works)"),
        ("rasterizer metal", "native=[1]", "pip uninstall sw-native-list  (what else it provides works)"),
        ("entries of sw-zz-crash", "was killed by signal SIGABRT", UPGRADE.format("sw-zz-crash")),
        ("metric lacks", "No module named 'no_such_library'", "pip install no_such_library"),
        ("lightning", "RuntimeError: no such GPU", UPGRADE.format("sw-lightning")),
    ],
)  # fmt: skip
def test_doctor_lists_who_is_broken_or_refused_with_the_cure_that_helps(diagnosis, name, said, mend):
    check = diagnosis[name]
    assert said in check["detail"]
    assert (check["state"], check["needed"]) == ("broken", False)
    told = as_written(check["mend"])
    assert told == mend or (isinstance(mend, re.Pattern) and mend.fullmatch(told))


def test_doctor_says_that_the_main_job_works_whatever_strangers_lack(diagnosis):
    assert {check["state"] for check in diagnosis.values() if check["needed"]} == {"ok"}
    assert diagnosis["sw run --method 3dgs --scene demo"]["facts"]["rasterizer"] not in (
        "boaster",
        "lightning",
        "exits",
        "lies",
    )


# --------------------------------------------------------------------------------------- damaged by their files


def test_a_list_of_entry_points_that_cannot_be_read_hides_nobody(tmp_path):
    site = Site(tmp_path)
    site.install("sw-good", metric("good", "sw_good"))
    site.install("sw-damaged", metric("damaged", "sw_damaged"))
    (tmp_path / "sw_damaged-0.1.dist-info" / "entry_points.txt").write_bytes(b"[splatwizard]\nno equals sign\n\xff")
    done = site.sw("list-plugins", "--json")
    found = Listed(json.loads(done.stdout))
    assert found.working["sw-good"] == {"metric good"}
    assert "sw-3dgs" in found.working
    assert len([line for line in done.stderr.splitlines() if "sw-damaged" in line]) == 1
