"""benchmarks/results_matrix.py: order, resuming, deadline, and what is noted beside a run; `sw` itself is replaced."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

SCRIPT = Path(__file__).parents[1] / "benchmarks" / "results_matrix.py"


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(SCRIPT.parent))
    spec = importlib.util.spec_from_file_location("results_matrix", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "results_matrix", module)
    spec.loader.exec_module(module)
    monkeypatch.setattr(module, "MOMENT", 0.001)
    return module


@pytest.fixture
def start(script: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Run the command; returns the `sw` command lines that it gave."""

    def started(*arguments: str, fails: str = "nothing", status: int = 0) -> list[list[str]]:
        given: list[list[str]] = []

        def call(self, words, gpu, places, output, limit):
            given.append(words)
            if fails in words:
                return 1
            if words[0] == "run":
                out, method = Path(words[words.index("--out") + 1]), words[words.index("--method") + 1]
                run = out / "demo-tiny" / method / {"3dgs": "r3", "lightgaussian": "r3", "hac": "r4"}[method]
                run.mkdir(parents=True, exist_ok=True)
                (run / "metrics.json").write_text("{}")
            else:
                output.write('warning {"speed": {"fps": 5}, "memory": {"kind": "cuda"}, "other": 1}')
                output.flush()
            return 0

        monkeypatch.setattr(script.Matrix, "_call", call)
        standard = ["results_matrix.py", str(tmp_path), "--scenes", "demo:tiny", "--device", "cpu"]
        monkeypatch.setattr(sys, "argv", [*standard, *arguments])
        assert script.main() == status
        return given

    return started


def asked(given: list[list[str]]) -> list[tuple[str, str]]:
    """(method, seed) of the trainings, in order."""
    runs = [words for words in given if words[0] == "run"]
    return [(words[words.index("--method") + 1], words[words.index("--seed") + 1]) for words in runs]


def test_the_shared_scene_goes_first_then_the_longest_seed_by_seed(start):
    given = start("--methods", "lightgaussian,hac,3dgs", "--seeds", "0,1")
    assert asked(given) == [(m, s) for s in "01" for m in ("3dgs", "hac", "lightgaussian")]
    assert [words[0] for words in given].count("eval") == 6
    outs = {(words[words.index("--out") + 1]) for words in given if words[0] == "run"}
    assert sorted(Path(out).name for out in outs) == ["seed-0", "seed-1"]  # one for all methods of a seed: they share


def test_what_is_finished_is_not_run_again_unless_it_is_asked_for_otherwise(start, tmp_path):
    start("--methods", "3dgs", "--seeds", "0")
    (note,) = tmp_path.rglob("matrix.json")
    kept = json.loads(note.read_text())
    assert kept["quiet"] == {"speed": {"fps": 5}, "memory": {"kind": "cuda"}}
    assert (kept["processes_per_gpu"], kept["command"].split()[:4]) == (1, ["sw", "run", "--method", "3dgs"])
    assert start("--methods", "3dgs", "--seeds", "0") == []
    assert len(start("--methods", "3dgs", "--seeds", "0", "--set", "iterations=7")) == 1


def test_a_run_keeps_the_command_that_made_it_when_further_rate_points_are_made(start, tmp_path):
    start("--methods", "3dgs@r3", "--seeds", "0", "--no-measure")
    old = tmp_path / "seed-0" / "demo-tiny" / "3dgs" / "r1"
    old.mkdir()
    (old / "metrics.json").write_text("{}")
    (old / "matrix.json").write_text('{"command": "of r1"}')
    os.utime(old / "metrics.json", (1, 1))
    start("--methods", "3dgs@r3+r4", "--seeds", "0", "--no-measure")
    assert json.loads((old / "matrix.json").read_text())["command"] == "of r1"
    assert "--rate r3,r4" in json.loads((old.parent / "r3" / "matrix.json").read_text())["command"]


def test_settings_of_one_method_reach_that_one(start):
    given = start("--methods", "3dgs,hac", "--seeds", "0", "--set", "iterations=9", "--set", "voxel_size=0.1@hac")
    by_method = {words[words.index("--method") + 1]: words for words in given if words[0] == "run"}
    assert "voxel_size=0.1" in by_method["hac"]
    assert "voxel_size=0.1" not in by_method["3dgs"]
    assert all("iterations=9" in words for words in by_method.values())


def test_a_failure_stops_what_needs_it_and_nothing_else(start, capsys):
    given = start("--methods", "lightgaussian,hac,3dgs", "--seeds", "0", fails="3dgs", status=1)
    assert asked(given) == [("3dgs", "0"), ("hac", "0")]
    assert "lightgaussian demo:tiny seed 0: what it starts from has failed" in capsys.readouterr().out


def test_after_the_deadline_nothing_begins(start, capsys):
    assert start("--methods", "3dgs,hac", "--seeds", "0", "--deadline", "0", "--quiet", "0") == []
    assert "no time for 2 runs" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("scene", "folder"),
    [("demo:tiny", "demo-tiny"), ("data/fox", "fox"), ("nerf_synthetic:data/lego", "lego"), ("demos/fox", "fox")],
)
def test_runs_are_looked_for_where_sw_run_puts_them(script, scene, folder):
    assert script.scene_name(scene) == folder


def test_a_link_to_a_scene_is_named_as_sw_run_names_it(script, tmp_path):
    (tmp_path / "lego").mkdir()
    (tmp_path / "link").symlink_to("lego")
    assert script.scene_name(str(tmp_path / "link")) == "lego"


def test_an_interrupted_process_is_given_time_for_its_checkpoint(script, monkeypatch, tmp_path):
    noted = tmp_path / "noted"
    program = (
        "import pathlib, signal, sys, time\n"
        "def stop(*_):\n"
        f"    pathlib.Path({str(noted)!r}).write_text('checkpoint'); sys.exit(0)\n"
        "signal.signal(signal.SIGINT, stop)\n"
        f"pathlib.Path({str(tmp_path / 'ready')!r}).touch()\n"
        "time.sleep(3600)\n"
    )
    folder = tmp_path / "splatwizard_core"
    folder.mkdir()
    (folder / "__main__.py").write_text(program)
    (folder / "__init__.py").touch()
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    # Its time is up when it is ready, however long that takes: the clock of `subprocess` stands still before.
    monkeypatch.setattr(subprocess, "_time", lambda: 1e9 if (tmp_path / "ready").exists() else 0.0)
    monkeypatch.setattr(script, "PATIENCE", float("inf"))
    with open(tmp_path / "output", "w") as output:
        status = script.Matrix._call(None, ["run"], "", 1, output, 5.0)
    assert status == 1  # the run did not finish, whatever its own status
    assert noted.read_text() == "checkpoint"


def test_rates_of_one_method_stand_behind_its_name(start):
    given = start("--methods", "3dgs@r2+r6,hac", "--seeds", "0")
    rates = {
        words[words.index("--method") + 1]: words[words.index("--rate") + 1] for words in given if words[0] == "run"
    }
    assert rates == {"3dgs": "r2,r6", "hac": "default"}
