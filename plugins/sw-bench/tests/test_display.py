"""The live table, drawn into a text: counts, failures, what is running, and how long the rest takes."""

from __future__ import annotations

import io
import json
from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console
from sw_bench import display
from sw_bench.cells import Cell, run_job
from sw_bench.display import Lines, LiveTable
from sw_bench.estimates import Estimates


def cell(root: Path, label: str, scene: str, rate: str) -> Cell:
    resolved = SimpleNamespace(ppl=SimpleNamespace(seed=0), rate=rate, method=label)
    made = Cell(label, scene, resolved, root, ())
    made.__dict__["directory"] = root / scene / label / rate
    return made


@pytest.fixture
def sweep(tmp_path, monkeypatch):
    """One run finished before, one running, one waiting, of two methods on two scenes; the fourth is no run."""
    monkeypatch.setattr(display, "time", SimpleNamespace(monotonic=lambda: 100.0))
    cells = [cell(tmp_path, "a", "x/garden", "r1"), cell(tmp_path, "b", "x/garden", "r1"),
             cell(tmp_path, "a", "room", "r2")]  # fmt: skip
    jobs = [run_job([each]) for each in cells]
    return SimpleNamespace(
        cells=cells, jobs=jobs, waiting=[jobs[2]], running={"t": (jobs[1], 30.0, 0)},
        executor=SimpleNamespace(slots=2),
    )  # fmt: skip


def table(sweep, **options) -> LiveTable:
    return LiveTable(sweep.cells, sweep.cells[:1], Estimates([("b", "x/garden", 100.0)]), Console(file=io.StringIO()))


def text(shown: LiveTable, sweep, width=100) -> str:
    console = Console(file=io.StringIO(), width=width)
    console.print(shown.picture(sweep))
    return console.file.getvalue()


def test_it_counts_by_method_and_scene_and_shows_what_runs(sweep):
    shown = table(sweep)
    shown.started(sweep, sweep.jobs[1])
    directory = sweep.cells[1].directory
    directory.mkdir(parents=True)
    log = "".join(json.dumps({"stage": 0, "step": step, "pad": "-" * 90}) + "\n" for step in range(10, 800, 10))
    (directory / "log.jsonl").write_text(log + '{"stage": 0, "st')
    lines = text(shown, sweep).splitlines()
    garden = next(line for line in lines if "garden" in line)
    assert [part.strip() for part in garden.strip("│").split("│")] == ["garden", "1/1", "0/1"]
    room = next(line for line in lines if "room" in line and "│" in line)
    assert [part.strip() for part in room.strip("│").split("│")] == ["room", "0/1", ""]
    assert "  b x/garden seed 0 r1 · 1 min 10 s · step 790" in lines
    assert lines[-1].startswith("[1/3] runs · about 1 min")


def test_a_failure_is_counted_and_printed_above(sweep):
    sweep.index = SimpleNamespace(row=lambda each: SimpleNamespace(status="failed"))
    shown = table(sweep)
    shown.ended(sweep, sweep.jobs[1], "failed", "no memory", 3.0)
    assert "0/1 1 failed" in text(shown, sweep)
    assert "no memory" in shown._console.file.getvalue()


def test_without_a_terminal_it_says_every_half_minute_what_runs(sweep, monkeypatch, capsys):
    clock = SimpleNamespace(now=100.0)
    monkeypatch.setattr(display, "time", SimpleNamespace(monotonic=lambda: clock.now))
    shown = Lines(sweep.cells, sweep.cells[:1], Estimates([("b", "x/garden", 100.0)]))
    for clock.now in (101.0, 129.0, 130.0, 131.0, 159.0, 160.5):
        shown.tick(sweep)
    first, second = capsys.readouterr().err.splitlines()
    assert first.startswith("[1/3] running   b x/garden seed 0 r1, 1 min 40 s · about ")
    assert second.startswith("[1/3] running   b x/garden seed 0 r1, 2 min 10 s")
    shown.started(sweep, sweep.jobs[1])
    capsys.readouterr()
    clock.now += 29  # since the last line of any kind
    shown.tick(sweep)
    sweep.running = {}
    clock.now += 60
    shown.tick(sweep)
    assert not capsys.readouterr().err


@pytest.mark.parametrize("width", [40, 80, 200])
def test_no_line_is_wider_than_the_terminal(sweep, width):
    assert max(len(line) for line in text(table(sweep), sweep, width).splitlines()) <= width
