"""benchmarks/published.py: rows are run once, put beside what was published, and missing data is named."""

from __future__ import annotations

import importlib.util
import json
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

from splatwizard_core.plugins import load_plugins
from splatwizard_core.runs.config import parse_set, resolve

SCRIPT = Path(__file__).parents[1] / "benchmarks" / "published.py"
RECORD = {
    "schema_version": 3, "method": "3dgs", "rate": "r6", "preset": "paper", "dataset": "demo", "scene": "demo-tiny",
    "metrics": {"psnr": {"mean": 31.5}, "ssim": {"mean": 0.9}}, "file": {"bytes": 1234}, "test_views": 2,
    "counts": {"num_gaussians": 50}, "train": {"steps": 5}, "protocol": {"id": "demo/64x48", "background": "white"},
}  # fmt: skip


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    spec = importlib.util.spec_from_file_location("published", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "published", module)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def start(script: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys):
    """Run the command on three fake rows; returns the commands given to `sw` and what was printed."""
    content = json.loads(script.ROWS.read_text("utf-8"))
    real = next(f for f in content["figures"] if (f["method"], f["scene"], f["rate"]) == ("hac", "lego", "r1"))
    rows = [
        {**real, "method": "3dgs", "rate": "r6", "scene": "demo:tiny", "dataset": "", "sets": [], "differs": []},
        {**real, "scene": "absent", "dataset": "nowhere", "verified": False},
        {**real, "scene": None},
    ]
    path = tmp_path / "rows.json"

    def started(*arguments: str, dataset: str = "nowhere") -> tuple[list[list[str]], str]:
        rows[1] |= {"dataset": dataset, "scene": "absent" if dataset == "nowhere" else real["scene"]}
        path.write_text(json.dumps({**content, "figures": rows}))
        given = []

        def run(command, **_):
            given.append(command[3:])
            out = Path(command[command.index("--out") + 1])
            folder = out / "demo-tiny" / "3dgs" / "r6"
            folder.mkdir(parents=True)
            (folder / "metrics.json").write_text(json.dumps(RECORD))
            return SimpleNamespace(returncode=0)

        monkeypatch.setattr(script.subprocess, "run", run)
        monkeypatch.setattr(sys, "argv", ["published.py", str(tmp_path / "out"), "--rows", str(path), *arguments])
        assert script.main() == 0
        return given, capsys.readouterr().out

    return started


def test_a_row_is_run_once_and_stands_beside_what_was_published(start, monkeypatch, tmp_path):
    monkeypatch.setenv("SPLATWIZARD_DATA", str(tmp_path))
    given, told = start("--set", "iterations=5")
    assert [words[:3] for words in given] == [["run", "--method", "3dgs"]]
    assert given[0][-2:] == ["--set", "iterations=5"]
    assert "31.50 / 35.04" in told
    assert "1,234 / 1,313,656" in told
    assert f"{tmp_path / 'nowhere' / 'absent'} is not there" in told
    assert "not re-read" in told
    given, told = start()
    assert given == []
    assert "31.50 / 35.04" in told


@pytest.fixture
def other_run(tmp_path: Path):
    """other_run(seed, **changes): keep a record of hac r1 on lego below tmp_path/h200, as a matrix of runs does."""
    ours = {"method": "hac", "rate": "r1", "preset": "paper", "dataset": "blender", "scene": "lego"}

    def kept(seed: int, **changes: object) -> None:
        folder = tmp_path / "h200" / f"seed-{seed}" / "lego" / "hac" / "r1"
        folder.mkdir(parents=True)
        (folder / "metrics.json").write_text(json.dumps({**RECORD, **ours, **changes}))

    return kept


def test_finished_runs_stand_for_a_row_with_their_mean_and_what_differs(start, other_run, tmp_path, monkeypatch):
    monkeypatch.delenv("SPLATWIZARD_DATA", raising=False)
    other_run(0, metrics={"psnr": {"mean": 33.0}})
    other_run(1, metrics={"psnr": {"mean": 34.0}}, file={"bytes": 1236})
    other_run(2, preset="mcmc")
    other_run(3, rate="r2")
    other_run(4, dataset="colmap")  # another scene of that name
    given, told = start("--table", "--runs", str(tmp_path / "h200"), "--only", "lego", dataset="nerf_synthetic")
    assert given == []
    assert "33.50 / 35.04" in told
    assert "1,235 / 1,313,656" in told
    assert "background white here, black there" in told
    assert "2 test views here, 200 there" in told
    assert "preset" not in told.replace("preset paper", "")


def test_a_record_that_cannot_be_read_is_told_once_and_left_out(script, other_run, tmp_path, capsys):
    row = next(r for r in script.read_rows(script.ROWS) if (r.figure.method, r.scene, r.rate) == ("hac", "lego", "r1"))
    own = row.run(tmp_path / "out")
    own.mkdir(parents=True)
    (own / "metrics.json").write_text("{")
    other_run(0, metrics={"psnr": {"mean": 33.0}})
    other_run(1, metrics=3)
    others = script.finished([tmp_path / "h200"])
    assert [run.mean("psnr") for run in script.measured(row, tmp_path / "out", others)] == [33.0]
    script.print_table([row], tmp_path / "out", others, script.Console(width=160))
    told, wrong = capsys.readouterr()
    assert "33.00 / 35.04" in told
    assert [line.split(": ")[1] for line in wrong.splitlines()] == [
        str(tmp_path / "h200" / "seed-1" / "lego" / "hac" / "r1" / "metrics.json"), str(own / "metrics.json"),
    ]  # fmt: skip


def test_runs_of_the_preset_that_is_meant_come_before_those_of_paper(script, other_run, tmp_path):
    row = next(r for r in script.read_rows(script.ROWS) if (r.figure.method, r.scene, r.rate) == ("hac", "lego", "r1"))
    row = replace(row, preset="inria")
    other_run(0)
    found = script.measured(row, tmp_path, script.finished([tmp_path / "h200"]))
    assert [run.preset for run in found] == ["paper"]
    other_run(1, preset="inria")
    found = script.measured(row, tmp_path, script.finished([tmp_path / "h200"]))
    assert [run.preset for run in found] == ["inria"]


def test_a_folder_of_runs_that_is_not_there_is_named(start, tmp_path, capsys):
    with pytest.raises(SystemExit):
        start("--runs", str(tmp_path / "nowhere"))
    assert f"--runs: no folder {tmp_path / 'nowhere'}" in capsys.readouterr().err


def test_without_data_nothing_runs_but_what_needs_none(start, monkeypatch):
    monkeypatch.delenv("SPLATWIZARD_DATA", raising=False)
    _, told = start()
    assert "nowhere/absent: SPLATWIZARD_DATA is not set" in told
    given, told = start("--table", "--only", "absent")
    assert given == []
    assert "is not" not in told.replace("not re-read", "").replace("not measured yet", "")


def test_the_rows_can_be_run_and_say_where_they_come_from(script):
    rows, plugins = script.read_rows(script.ROWS), load_plugins()
    assert len({(r.name, r.preset) for r in rows}) == len(rows) >= 50
    for row in rows:
        of = row.figure
        resolve(plugins.methods.load(of.method), row.preset, row.rate, sets=parse_set(of.sets), scene="demo:tiny")
        assert of.psnr is not None
    assert any(not row.figure.verified for row in rows)
