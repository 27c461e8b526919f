"""`sw bench` and `sw run` with several scenes or seeds, on the smallest scene: killed, resumed, changed."""

from __future__ import annotations

import contextlib
import json
import os
import random
import signal
import sqlite3
import subprocess
import sys
import time
from pathlib import Path

import pytest

import splatwizard_core.runs.fresh
from splatwizard_core.cli.main import main

pytest.importorskip("sw_3dgs", reason="a sweep needs a method")

PLAN = """
methods = ["3dgs"]
scenes = ["demo:tiny", "{scene}"]
rates = "r1"
device = "cpu"
set = {{ iterations = {steps} }}
"""


def start(*words: str, cwd: Path) -> subprocess.Popen[str]:
    """Start `sw`."""
    return subprocess.Popen(
        [sys.executable, "-m", "splatwizard_core", *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        cwd=cwd, env={**os.environ, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip


def table(out: Path) -> list[dict[str, object]]:
    """Scores and sizes of every record below a folder, by its place."""
    found = []
    for path in sorted(out.rglob("metrics.json")):
        record = json.loads(path.read_text())
        scores = {name: block["mean"] for name, block in record["metrics"].items()}
        found.append({"at": str(path.relative_to(out)), "sha256": record["file"]["sha256"], "scores": scores})
    return found


@contextlib.contextmanager
def index_of(out: Path):
    with contextlib.closing(sqlite3.connect(out / "bench.sqlite")) as index:
        index.row_factory = sqlite3.Row
        yield index


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    """A sweep of two scenes, one of which has a picture that is cut off: its folder and its exit status."""
    folder = tmp_path_factory.mktemp("sweep")
    assert main(["data", "synth", str(folder / "spoilt"), "--size", "tiny"]) == 0
    picture = next((folder / "spoilt").rglob("*.png"))
    picture.write_bytes(picture.read_bytes()[:300])
    (folder / "plan.toml").write_text(PLAN.format(scene=folder / "spoilt", steps=3))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sw_bench.local.subprocess", splatwizard_core.runs.fresh.subprocess)
        return folder, main(["bench", str(folder / "plan.toml"), "--out", str(folder / "out")])


@pytest.mark.pipeline
def test_a_run_that_fails_stops_no_other_and_stands_in_the_index_with_its_reason(swept):
    folder, status = swept
    assert status == 1
    assert [row["at"] for row in table(folder / "out")] == ["seed-0/demo-tiny/3dgs/r1/metrics.json"]
    with index_of(folder / "out") as index:
        rows = {Path(row["scene"]).name: row for row in index.execute("SELECT * FROM runs")}
    assert rows["demo:tiny"]["status"] == "finished"
    assert rows["demo:tiny"]["directory"] == "seed-0/demo-tiny/3dgs/r1"
    assert rows["spoilt"]["status"] == "failed"
    assert "the picture cannot be decoded" in rows["spoilt"]["reason"]
    assert rows["spoilt"]["command"].startswith("sw run --scene")


@pytest.mark.pipeline
def test_the_same_command_goes_on_with_what_is_not_finished(swept, capsys):
    folder, _ = swept
    assert main(["bench", str(folder / "plan.toml"), "--out", str(folder / "out"), "--dry-run", "--no-probe"]) == 0
    told = capsys.readouterr()
    assert "2 runs of 1 method x 2 scenes x 1 seed: 1 finished, 1 new; 1 process," in told.err
    assert "spoilt" in told.out
    assert "demo:tiny" not in told.out


@pytest.mark.pipeline
def test_a_plan_with_other_values_discards_nothing_unasked(swept, capsys):
    folder, _ = swept
    (folder / "changed.toml").write_text(PLAN.format(scene=folder / "spoilt", steps=4))
    before = table(folder / "out")
    assert main(["bench", str(folder / "changed.toml"), "--out", str(folder / "out")]) == 2
    told = capsys.readouterr().err
    assert "1 of 2 runs were trained with other values (3dgs demo:tiny seed 0 r1: iterations 3 -> 4)" in told
    assert "--rerun-changed discards those" in told
    assert table(folder / "out") == before
    asked = ["--rerun-changed", "--dry-run", "--no-probe", "--json"]
    assert main(["bench", str(folder / "changed.toml"), "--out", str(folder / "out"), *asked]) == 0
    states = [each["state"] for process in json.loads(capsys.readouterr().out)["processes"] for each in process["runs"]]
    assert states == ["changed", "new"]


@pytest.mark.pipeline
def test_a_part_of_a_plan_leaves_the_rest_of_the_index(swept, capsys):
    folder, _ = swept
    words = [str(folder / "plan.toml"), "--out", str(folder / "out"), "--scene", "demo:tiny"]
    assert main(["bench", *words]) == 0
    told = capsys.readouterr()
    assert "not in the plan any more" not in told.err
    assert "spoilt" not in told.out
    with index_of(folder / "out") as index:
        rows = {Path(row["scene"]).name: row["status"] for row in index.execute("SELECT * FROM runs")}
    assert rows == {"demo:tiny": "finished", "spoilt": "failed"}


@pytest.mark.pipeline
def test_a_damaged_index_is_told(swept, capsys):
    folder, _ = swept
    (folder / "other").mkdir()
    (folder / "other" / "bench.sqlite").write_bytes(b"no database" * 100)
    assert main(["bench", str(folder / "plan.toml"), "--out", str(folder / "other")]) == 2
    assert "bench.sqlite: file is not a database: move it away" in capsys.readouterr().err


def test_sw_run_with_several_scenes_or_seeds_is_a_sweep(monkeypatch, capsys, tmp_path):
    asked = []

    def take(wanted, given):
        asked.append((wanted, given))
        return 0

    monkeypatch.setattr("sw_bench.running.bench_plan", take)
    words = ["run", "--method", "3dgs,lightgaussian", "--rate", "r1", "--set", "iterations=3", "--out", str(tmp_path)]
    assert main([*words, "--scene", "demo,demo:tiny"]) == 0
    assert main([*words, "--scene", "demo", "--seed", "0,2", "--fresh"]) == 0
    (first, _), (second, given) = asked
    assert (first.plan.methods, first.plan.scenes) == (("3dgs", "lightgaussian"), ("demo", "demo:tiny"))
    assert (first.plan.rates, first.plan.set, first.layout.root(0)) == ("r1", {"iterations": "3"}, tmp_path)
    assert (second.plan.seeds, second.layout.root(2)) == ((0, 2), tmp_path / "seed-2")
    assert given["resume"] is False


def test_several_seeds_of_a_configuration_file_take_its_method_scene_and_rate(monkeypatch, capsys, tmp_path):
    from splatwizard_core.tooling import Choices, load_plugins

    chosen = Choices(methods=("lightgaussian",), scene="demo:tiny", rate="r2", sets=("iterations=3",))
    (tmp_path / "config.toml").write_text(chosen.resolve(load_plugins())[0].toml())
    words = ["--config", str(tmp_path / "config.toml"), "--out", str(tmp_path / "out")]
    asked = []
    monkeypatch.setattr("sw_bench.running.bench_plan", lambda wanted, given: asked.append(wanted) or 0)
    assert main(["run", *words, "--seed", "0,1"]) == 0
    assert (asked[0].plan.methods, asked[0].plan.scenes, asked[0].plan.rates) == (
        ("lightgaussian",), ("demo:tiny",), None
    )  # fmt: skip
    monkeypatch.undo()
    assert main(["bench", *words, "--seed", "0,1", "--dry-run", "--no-probe", "--json"]) == 0
    (_, first, *_), out = json.loads(capsys.readouterr().out)["processes"], tmp_path / "out"
    assert [run["directory"] for run in first["runs"]] == [str(out / "seed-1" / "demo-tiny" / "lightgaussian" / "r2")]


def test_options_of_an_executor_may_be_in_a_table(monkeypatch, tmp_path):
    asked = []
    monkeypatch.setattr("sw_bench.running.bench_plan", lambda wanted, given: asked.append(wanted) or 0)
    (tmp_path / "plan.toml").write_text(
        'methods = ["3dgs"]\nscenes = ["demo"]\n[options]\ncores = 2\nextra = { constraint = "a", qos = "low" }\n'
    )
    assert main(["bench", str(tmp_path / "plan.toml"), "-o", "extra.constraint=v100", "-o", "extra.mail-type=END"]) == 0
    assert asked[0].plan.options == {
        "cores": 2, "extra": {"constraint": "v100", "qos": "low", "mail-type": "END"}
    }  # fmt: skip


@pytest.mark.pipeline
@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("", "name a PLAN.toml, or what to run by --method, --scene and --seed"),
        ("--method 3dsg", "no method is called '3dsg'; did you mean '3dgs'?"),
        ("--scene nowhere", "3dgs on nowhere: scene 'nowhere' is not there"),
        ("--scene demo:tiny --rate r9", "3dgs on demo:tiny: method '3dgs' has no rate point 'r9'"),
        ("--scene demo:tiny --set itertions=3", "unknown key 'itertions' in --set: did you mean 'iterations'?"),
        ("--scene demo:tiny --executor lokal", "no executor is called 'lokal'; did you mean 'local'?"),
        ("--scene demo:tiny -o workes=2", "executor 'local' has no option 'workes': did you mean 'workers'?"),
        ("--scene demo:tiny -o workers=many", "bad value 'many' for option 'workers' of 'local'"),
        ("--scene demo:tiny -o workers=2 -o workers.x=2", "option 'workers' is no table"),
        ("--scene demo:tiny -o workers=100000", "workers = 100000: this machine has "),
        ("--scene demo:tiny --seed 0,x", "'x' is not a valid integer"),
        ("--scene demo:tiny --out plan.toml/x", "cannot write into plan.toml/x"),
        ("plan.toml --rate r1", "--rate stands in the plan, plan.toml"),
        ("plan.toml --scene dmo:tiny", "no scene of the plan is called 'dmo:tiny': did you mean 'demo:tiny'?"),
        ("skipped.toml", "the plan leaves no run: every one is skipped"),
        ("twins.toml", "would share the folder"),
    ],
)
def test_wrong_sweeps_are_told_before_anything_runs(words, told, swept, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    head = 'methods = ["3dgs"]\nscenes = ["demo:tiny"]\n'
    (tmp_path / "plan.toml").write_text(head)
    (tmp_path / "skipped.toml").write_text(head + '[[override]]\nmethods = ["3dgs"]\nskip = true\n')
    twin = swept[0] / "spoilt"
    (tmp_path / "twins.toml").write_text(f'methods = ["3dgs"]\nscenes = ["{twin}", "{twin.parent}/./spoilt"]\n')
    before = sorted(tmp_path.rglob("*"))
    assert main(["bench", *words.split()]) == 2
    error = capsys.readouterr().err
    assert told in error
    assert len(error.splitlines()) == 1
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.slow
def test_a_sweep_whose_process_is_killed_goes_on_where_it_was(tmp_path):
    """kill -9 of the sweep: its process ends with a checkpoint, and the same command goes on from it."""
    (tmp_path / "plan.toml").write_text(
        'methods = ["3dgs"]\nscenes = ["demo:tiny"]\nrates = ["r1", "r2"]\ndevice = "cpu"\n'
        "set = { iterations = 400, checkpoint_every = 5 }\n"
    )
    first = start("bench", "plan.toml", cwd=tmp_path)
    out = tmp_path / "out" / "plan"
    until = time.monotonic() + 120
    while not list(out.glob("seed-0/demo-tiny/3dgs/r1/checkpoints/*.json")):
        assert time.monotonic() < until, first.communicate()
        assert first.poll() is None, first.communicate()
        time.sleep(0.02)
    first.send_signal(signal.SIGKILL)
    first.communicate()
    assert not table(out)
    second = start("bench", "plan.toml", "--json", cwd=tmp_path)
    told, said = second.communicate(timeout=300)
    assert second.returncode == 0, said
    assert "2 runs: 1 new, 1 goes on; 1 processes to go" in said
    rows = json.loads(told)["runs"]
    assert [(row["label"], row["rate"], row["seeds"], row["failed"]) for row in rows] == [
        ("3dgs", "r1", [0], {}), ("3dgs", "r2", [0], {})
    ]  # fmt: skip


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_a_sweep_that_was_killed_three_times_ends_with_the_same_table(tmp_path):
    """Killed at random, its files and scores are those of the sweep that nobody interrupted."""
    assert main(["data", "synth", str(tmp_path / "other"), "--size", "tiny"]) == 0
    words = ["bench", "--method", "3dgs,lightgaussian", "--scene", f"demo:tiny,{tmp_path / 'other'}"]
    words += ["--rate", "r1,r2", "--set", "iterations=60", "--set", "pretrained.iterations=60", "-o", "workers=2"]
    words += ["--set", "checkpoint_every=10", "--device", "cpu"]
    rng = random.Random(18)
    for _ in range(3):
        killed = start(*words, "--out", "killed", cwd=tmp_path)
        time.sleep(rng.uniform(15, 40))
        killed.send_signal(rng.choice([signal.SIGKILL, signal.SIGTERM]))
        killed.communicate()
    for out in ("killed", "quiet"):
        done = start(*words, "--out", out, cwd=tmp_path)
        _, said = done.communicate()
        assert done.returncode == 0, said
    assert table(tmp_path / "killed") == table(tmp_path / "quiet")
    assert len(table(tmp_path / "quiet")) == 8
