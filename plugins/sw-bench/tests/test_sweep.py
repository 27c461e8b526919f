"""The course of a sweep, with an executor whose processes end as a script says: no run is really made."""

from __future__ import annotations

import json
import sqlite3
from contextlib import closing, suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import pytest
from sw_bench import results, state, sweep
from sw_bench.cells import Cell, Job, SharedTraining, run_job
from sw_bench.display import Lines
from sw_bench.estimates import Estimates
from sw_bench.executor import LOST
from sw_bench.index import Index
from sw_bench.sweep import Sweep

KILLED = -9


def cell(root: Path, label: str = "a", rate: str = "r1", seed: int = 0) -> Cell:
    resolved = SimpleNamespace(
        ppl=SimpleNamespace(seed=seed), rate=rate, method=label, preset="paper", config_hash=lambda: "hash"
    )
    made = Cell(label, "demo", resolved, root, ("--method", label))
    made.__dict__["directory"] = root / "demo" / label / f"{rate}-{seed}"
    return made


@dataclass
class Scripted:
    """An executor that is told how each process ends, and makes the records of those that end well.

    script  name of a job -> for each start (status, rates that are finished, line in its log)
    """

    script: dict[str, list[tuple[int, str, str]]]
    cells: list[Cell]
    slots: int = 2
    started: list[str] = field(default_factory=list)
    most: int = 0
    stopped: bool = False
    trained: bool = True
    _running: dict[str, list[str]] = field(default_factory=dict)
    _logs: dict[str, Path] = field(default_factory=dict)

    def start(self, ticket, command, log):
        self.started.append(ticket)
        self._running[ticket], self._logs[ticket] = list(command), log
        self.most = max(self.most, len(self._running))

    def ended(self, timeout):
        if not self._running:
            return []
        ticket, command = next(iter(self._running.items()))
        del self._running[ticket]
        status, rates, line = self.script.get(ticket.rpartition(" #")[0], [(0, "all", "")]).pop(0)
        if "--train-shared" in command and status == 0:
            self._note_training(command)
        for each in self.cells:
            if (str(each.directory) in command and rates in ("all", "none")) or each.rate in rates.split(","):
                each.directory.mkdir(parents=True, exist_ok=True)
                if self.trained:
                    (each.directory / "steps.json").write_text('{"train": {}}')
                if rates != "none" and str(each.directory) in command:
                    (each.directory / "made").touch()
        with open(self._logs[ticket], "a") as log:
            log.write(line + "\n")
        return [(ticket, status, "here")]

    def _note_training(self, command):
        file = Path(command[command.index("--train-shared") + 1])
        home = file.with_suffix("")
        home.mkdir(parents=True)
        (home / "steps.json").write_text('{"train": {}}')
        file.with_suffix(".json").write_text(json.dumps({"directory": str(home)}))

    def stop(self):
        self.stopped = True


@pytest.fixture(autouse=True)
def records(monkeypatch):
    """A run is finished where its directory holds `made`."""

    def record_of(each):
        made = (each.directory / "made").exists()
        train = SimpleNamespace(pretraining={}, steps=3)
        return SimpleNamespace(file=SimpleNamespace(bytes=7), metrics={}, train=train) if made else None

    for module in (sweep, state, results):
        monkeypatch.setattr(module, "record_of", record_of)


class Made:
    """A sweep that was run, with what came of it."""

    def __init__(self, tmp_path, jobs, script, *, error=None, **options):
        self.cells = [each for job in jobs for each in job.cells]
        self.executor = Scripted(script, self.cells, **options)
        if error is not None:
            self.executor.ended = error
        self.index = Index(tmp_path)
        self.index.plan(self.cells)
        self.lines = []
        watcher = Lines(self.cells, [], Estimates())
        watcher.tell = self.lines.append
        self.sweep = Sweep(tmp_path, jobs, self.executor, self.index, watcher)

    def run(self):
        self.sweep.run()
        return self

    @property
    def states(self):
        rows = {each.rate if len({c.label for c in self.cells}) == 1 else each.label: self.index.row(each)
                for each in self.cells}  # fmt: skip
        return {name: (row.status, row.reason) for name, row in rows.items()}


def test_everything_runs_once_on_the_places_that_there_are(tmp_path):
    made = Made(tmp_path, [run_job([cell(tmp_path, label)]) for label in "abcde"], {}).run()
    assert made.executor.started == [f"{label} demo seed 0 r1 #1" for label in "abcde"]
    assert made.executor.most == 2
    assert made.executor.stopped
    assert set(made.states.values()) == {("finished", "")}
    assert made.lines[-1].startswith("[5/5] finished  e demo seed 0 r1")


def test_one_failure_stops_nothing_else_and_is_kept_with_its_reason(tmp_path):
    script = {"b demo seed 0 r1": [(1, "", "error: CUDA is out of memory\nan afterthought")]}
    made = Made(tmp_path, [run_job([cell(tmp_path, label)]) for label in "abc"], script, trained=False).run()
    assert made.states == {"a": ("finished", ""), "b": ("failed", "CUDA is out of memory"), "c": ("finished", "")}
    assert any("failed" in line and "CUDA is out of memory" in line for line in made.lines)


def test_after_a_failed_rate_point_the_others_of_its_training_are_made(tmp_path):
    job = run_job([cell(tmp_path, rate=rate) for rate in ("r1", "r2", "r3")])
    script = {
        "a demo seed 0 r1,r2,r3": [(1, "r1", "error: r2 does not decode")],
        "a demo seed 0 r3": [(0, "r3", "")],
    }
    made = Made(tmp_path, [job], script).run()
    assert made.states == {"r1": ("finished", ""), "r2": ("failed", "r2 does not decode"), "r3": ("finished", "")}


def finished_before(tmp_path, *rates):
    """Runs whose records are there."""
    cells = [cell(tmp_path, rate=rate) for rate in rates]
    for each in cells:
        each.directory.mkdir(parents=True)
        for name in ("made", "metrics.json"):
            (each.directory / name).write_text("before")
    return cells


def test_a_finished_run_that_cannot_be_done_again_has_failed(tmp_path):
    job = run_job(finished_before(tmp_path, "r1"))
    made = Made(tmp_path, [job], {job.name: [(1, "", "error: no picture")]}).run()
    assert made.states == {"r1": ("failed", "no picture")}
    assert "failed" in made.lines[-1]
    assert list(made.sweep.failed.values()) == ["no picture"]
    (row,) = results.results(made.cells, made.index)
    assert (row["seeds"], row["failed"], row["waiting"]) == ([0], {"0": "no picture"}, [])


def test_of_finished_runs_in_one_process_the_one_that_fails_is_found(tmp_path):
    job = run_job(finished_before(tmp_path, "r1", "r2", "r3"))
    script = {
        "a demo seed 0 r1,r2,r3": [(1, "none", "error: no picture")],
        "a demo seed 0 r2": [(1, "none", "error: no picture")],
    }
    made = Made(tmp_path, [job], script).run()
    assert made.states == {"r1": ("finished", ""), "r2": ("failed", "no picture"), "r3": ("finished", "")}


def test_a_training_that_fails_is_not_tried_for_every_rate_point(tmp_path):
    job = run_job([cell(tmp_path, rate=rate) for rate in ("r1", "r2")])
    made = Made(tmp_path, [job], {job.name: [(1, "", "error: it diverged")]}, trained=False).run()
    assert len(made.executor.started) == 1
    assert made.states == dict.fromkeys(("r1", "r2"), ("failed", "it diverged"))


@pytest.mark.parametrize("status", [KILLED, LOST, 130, 137])
def test_what_was_killed_goes_on_and_fails_after_the_last_retry(tmp_path, status):
    jobs = [run_job([cell(tmp_path, label)]) for label in "ab"]
    script = {jobs[0].name: [(status, "", "")] * 2 + [(0, "all", "")], jobs[1].name: [(status, "", "")] * 3}
    made = Made(tmp_path, jobs, script, trained=False).run()
    assert made.states["a"] == ("finished", "")
    assert made.states["b"][0] == "failed"
    assert {KILLED: "killed by SIGKILL", 137: "killed by SIGKILL", LOST: "its machine was lost", 130: "interrupted"}[
        status
    ] in made.states["b"][1]
    assert sorted(made.executor.started) == [f"{job.name} #{i}" for job in jobs for i in (1, 2, 3)]


def shared(tmp_path) -> Job:
    training = SharedTraining(tmp_path / ".shared" / "x.toml", tmp_path, None)
    return Job(
        "scene", ("bench", "--train-shared", str(training.file), "root"), shared=training, about=("scene", "demo")
    )


def test_what_several_start_from_is_trained_first_and_once(tmp_path):
    base, jobs = shared(tmp_path), [run_job([cell(tmp_path, label)]) for label in "ab"]
    for job in jobs:
        job.needs = (base,)
    made = Made(tmp_path, [base, *jobs], {}).run()
    assert made.executor.started == ["scene #1", *(f"{label} demo seed 0 r1 #1" for label in "ab")]
    assert set(made.states.values()) == {("finished", "")}


def test_what_starts_from_a_failed_training_fails_with_its_reason(tmp_path):
    base, jobs = shared(tmp_path), [run_job([cell(tmp_path, label)]) for label in "ab"]
    jobs[0].needs = (base,)
    made = Made(tmp_path, [base, *jobs], {"scene": [(1, "", "error: no memory")]}).run()
    assert made.states == {"a": ("failed", "scene failed: no memory"), "b": ("finished", "")}
    assert [row["failed"] for row in results.results(made.cells, made.index)] == [{"0": "scene failed: no memory"}, {}]


def test_whatever_ends_a_sweep_its_processes_are_stopped_and_its_runs_wait(tmp_path):
    def interrupt(timeout):
        raise KeyboardInterrupt

    made = Made(tmp_path, [run_job([cell(tmp_path, label)]) for label in "abc"], {}, error=interrupt)
    with pytest.raises(KeyboardInterrupt):
        made.run()
    assert made.executor.stopped
    assert set(made.states.values()) == {("waiting", "")}


def test_discarding_a_run_leaves_what_is_not_its_own(tmp_path):
    from sw_bench.state import discard

    each = cell(tmp_path)
    discard(each)  # there is nothing yet
    (each.directory / "checkpoints").mkdir(parents=True)
    for name in ("metrics.json", "config.toml", "checkpoints/x", "notes.txt"):
        (each.directory / name).write_text("x")
    discard(each)
    assert sorted(path.name for path in each.directory.iterdir()) == [".lock", "notes.txt"]


def test_discarding_a_training_for_several_removes_it_and_its_note(tmp_path):
    from sw_bench.state import discard_shared, is_shared_training_done

    job, home = shared(tmp_path), tmp_path / ".trained" / "demo-a-key"
    discard_shared(job.shared)  # there is nothing yet
    home.mkdir(parents=True)
    (home / "steps.json").write_text('{"train": {}}')
    job.shared.note.parent.mkdir()
    for place, is_left in ((tmp_path / ".trained" / ".." / ".trained" / "demo-a-key", False), (tmp_path, True)):
        (place / "steps.json").write_text('{"train": {}}')
        job.shared.note.write_text(json.dumps({"directory": str(place.resolve())}))
        assert is_shared_training_done(job.shared)
        discard_shared(job.shared)
        assert not job.shared.note.exists()
        assert (place / "steps.json").exists() is is_left  # only of what lies among the trained scenes


def test_an_index_follows_its_plan(tmp_path):
    index = Index(tmp_path)
    first, second = cell(tmp_path, "a"), cell(tmp_path, "b")
    assert index.plan([first, second]) == []
    index.note(first, status="failed", reason="why")
    assert index.plan([first, cell(tmp_path, "c")]) == ["b demo seed 0 r1"]
    assert (index.row(first).status, index.row(first).reason) == ("failed", "why")


def test_a_free_place_is_taken_before_the_disk_is_waited_for(tmp_path):
    made = Made(tmp_path, [run_job([cell(tmp_path, label)]) for label in "ab"], {}, slots=1)
    start, seen = made.executor.start, []

    def watched(*arguments):
        with closing(sqlite3.connect(tmp_path / "bench.sqlite")) as other:
            seen.append([row[0] for row in other.execute("SELECT status FROM runs ORDER BY label")])
        start(*arguments)

    made.executor.start = watched
    made.run()
    assert seen == [["waiting", "waiting"], ["running", "waiting"]]  # that the first has ended is written afterwards
    assert set(made.states.values()) == {("finished", "")}


def test_changes_of_a_block_reach_the_disk_at_its_end_even_of_one_that_fails(tmp_path):
    index, one = Index(tmp_path), cell(tmp_path, "a")
    index.plan([one])
    with closing(sqlite3.connect(tmp_path / "bench.sqlite")) as other:
        with suppress(KeyboardInterrupt), index.together():
            index.note(one, status="failed")
            assert other.execute("SELECT status FROM runs").fetchall() == [("waiting",)]
            raise KeyboardInterrupt
        assert other.execute("SELECT status FROM runs").fetchall() == [("failed",)]


def test_an_index_that_is_none_is_refused(tmp_path):
    from splatwizard_core.api import UserInputError

    (tmp_path / "bench.sqlite").write_bytes(b"no database" * 100)
    with pytest.raises(UserInputError, match=r"bench.sqlite: .*move it away"):
        Index(tmp_path)


def test_estimates_come_from_the_nearest_that_is_known():
    estimates = Estimates([("a", "x", 10.0), ("b", "x", 20.0), ("a", "y", 30.0)])
    assert estimates.one("a", "x") == 10.0
    assert estimates.one("b", "y") == 60.0  # as much longer as a takes there
    assert estimates.one("a", "z") == 20.0
    assert estimates.one("c", "x") is None
    jobs = [Job(name, (), about=("a", "x")) for name in "ab"]
    assert estimates.left(jobs, [(jobs[0], 4.0)], 2) == 13.0
    assert Estimates().left(jobs, [], 1) is None
