"""The course of a sweep: starts processes as places become free, notes how each ended, and goes on whatever fails."""

from __future__ import annotations

import shlex
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from sw_bench.cells import Cell, Job, run_job
from sw_bench.executor import LOST, Executor
from sw_bench.index import Index
from sw_bench.state import is_shared_training_done, is_trained, record_of, stamp_of

LOGS = "logs"
MOMENT = 0.25  # seconds between two updates of what is shown
REASON_CHARACTERS = 300
KILLED = 9  # SIGKILL, which some systems lack
INTERRUPTED = (130, -signal.SIGINT, -signal.SIGTERM)


class Watcher(Protocol):
    """Sees what happens; the display is one."""

    def started(self, sweep: Sweep, job: Job) -> None: ...

    def ended(self, sweep: Sweep, job: Job, status: str, reason: str, seconds: float) -> None: ...

    def tick(self, sweep: Sweep) -> None: ...


@dataclass
class Sweep:
    """Processes of a plan that are waiting, running and ended.

    out         output folder, absolute
    retries     further starts of a process that was killed, or lost with its machine
    """

    out: Path
    jobs: Sequence[Job]
    executor: Executor
    index: Index
    watcher: Watcher
    retries: int = 2
    waiting: list[Job] = field(default_factory=list)
    running: dict[str, tuple[Job, float, int]] = field(default_factory=dict)
    done: set[Job] = field(default_factory=set)
    failed: dict[Job, str] = field(default_factory=dict)
    before: dict[Cell, tuple[int, int]] = field(default_factory=dict)  # stamps of records that were there already

    def run(self) -> None:
        """Run everything; returns when nothing is left. However it ends, the processes have ended with a checkpoint."""
        (self.out / LOGS).mkdir(exist_ok=True)
        self.waiting = list(self.jobs)
        stamps = {cell: stamp_of(cell) for job in self.jobs for cell in job.cells}
        self.before = {cell: stamp for cell, stamp in stamps.items() if stamp is not None}
        try:
            ended: list[tuple[str, int, str]] = []
            while self.waiting or self.running:
                # The index waits for the disk after a free place has its next process, not before.
                with self.index.together():
                    for ticket, status, place in ended:
                        self._finish(ticket, status, place)
                    self._start_what_can()
                self.watcher.tick(self)
                ended = self.executor.ended(MOMENT)
        finally:
            self.executor.stop()
            for job, _, _ in self.running.values():
                for cell in job.cells:
                    self.index.note(cell, status="waiting")

    def _start_what_can(self) -> None:
        """Start what waits for nothing, as long as there are places; what waits for a failure has failed."""
        for job in list(self.waiting):
            broken = next((need for need in job.needs if need in self.failed), None)
            if broken is not None:
                self.waiting.remove(job)
                self._fail(job, job.cells, f"{broken.name} failed: {self.failed[broken]}", 0.0)
        for job in list(self.waiting):
            if self.executor.slots is not None and len(self.running) >= self.executor.slots:
                return
            if all(need in self.done for need in job.needs):
                self.waiting.remove(job)
                self._start(job)

    def _start(self, job: Job) -> None:
        job.attempts += 1
        log = self.out / LOGS / job.log
        command = [
            sys.executable,
            "-m",
            "sw_bench.child",
            *(str(cell.directory) for cell in job.cells),
            "--",
            *job.words,
        ]
        for cell in job.cells:
            facts = {"command": shlex.join(["sw", *job.words]), "log": f"{LOGS}/{job.log}", "attempts": job.attempts}
            self.index.note(cell, status="running", reason="", **facts)
        size = log.stat().st_size if log.exists() else 0
        ticket = f"{job.name} #{job.attempts}"
        self.running[ticket] = job, time.monotonic(), size
        self.executor.start(ticket, command, log)
        self.watcher.started(self, job)

    def _finish(self, ticket: str, status: int, place: str) -> None:
        """Note how a process ended: finished, failed with its reason, or to be started again."""
        job, began, size = self.running.pop(ticket)
        seconds = time.monotonic() - began
        # The record of a run that was started again says that it went well only if it is a new one.
        left = [cell for cell in job.cells if record_of(cell) is None or (status != 0 and self._is_as_before(cell))]
        for cell in job.cells:
            self.index.spent(cell, seconds / len(job.cells))
            if cell not in left:
                self.index.note(cell, status="finished", reason="", place=place)
        whole = is_shared_training_done(job.shared) if job.shared is not None else not left
        if status == 0 and whole:
            self.done.add(job)
            self.index.job_ended(job.name, job.about, len(job.cells), "finished", seconds, place)
            self.watcher.ended(self, job, "finished", "", seconds)
            return
        reason = _reason(self.out / LOGS / job.log, size, status)
        if (status < 0 or status in INTERRUPTED or status == 128 + KILLED) and job.attempts <= self.retries:
            self.waiting.insert(0, job)  # goes on from its checkpoint
            for cell in left:
                self.index.note(cell, status="waiting")
            self.watcher.ended(self, job, "again", reason, seconds)
            return
        self.index.job_ended(job.name, job.about, len(job.cells), "failed", seconds, place)
        if len(left) > 1 and left[0] in self.before:  # there may have been nothing to do for it: each by itself
            self._start_again(job, [[cell] for cell in left])
            self.watcher.ended(self, job, "again", reason, seconds)
            return
        # The command ends with the first run that fails. Where their training is there, the others can still be made.
        others = left[1:] if left and any(is_trained(cell.directory) for cell in job.cells) else []
        self._start_again(job, [others] if others else [])
        self._fail(job, [cell for cell in left if cell not in others], reason, seconds)

    def _is_as_before(self, cell: Cell) -> bool:
        """Whether the record of a run is still the one that was there before the sweep began."""
        return cell in self.before and stamp_of(cell) == self.before[cell]

    def _start_again(self, job: Job, groups: Sequence[Sequence[Cell]]) -> None:
        """Let runs of a process that failed wait for processes of their own."""
        for group in reversed(groups):
            rest = run_job(group)
            rest.needs = job.needs
            self.waiting.insert(0, rest)
            for cell in group:
                self.index.note(cell, status="waiting")

    def _fail(self, job: Job, cells: Sequence[Cell], reason: str, seconds: float) -> None:
        self.failed[job] = reason
        for cell in cells:
            self.index.note(cell, status="failed", reason=reason)
        self.watcher.ended(self, job, "failed", reason, seconds)


def _reason(log: Path, start: int, status: int) -> str:
    """One line why a process failed: its last error message, or the signal that ended it."""
    if status == LOST:
        return "its machine was lost"
    if status == 130:
        return "interrupted"
    status = -KILLED if status == 128 + KILLED else status  # as a shell tells it
    if status < 0:
        name = signal.Signals(-status).name if -status in signal.valid_signals() else f"signal {-status}"
        return f"killed by {name}" + (" (the memory may have been full)" if -status == KILLED else "")
    try:
        with open(log, "rb") as file:
            file.seek(max(start, log.stat().st_size - 20_000))
            lines = [line.strip() for line in file.read().decode(errors="replace").splitlines() if line.strip()]
    except OSError:
        lines = []
    errors = [line for line in lines if line.startswith("error: ")]
    told = (errors or lines or [f"exit status {status}"])[-1].removeprefix("error: ")
    return told[:REASON_CHARACTERS]
