"""Progress of a sweep: a live table on a terminal, a line for each process elsewhere. Both on stderr."""

from __future__ import annotations

import json
import os
import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

from splatwizard_core.tooling import duration, say
from sw_bench.cells import Cell, Job
from sw_bench.estimates import Estimates

if TYPE_CHECKING:
    from rich.console import Console, RenderableType
    from rich.live import Live

    from sw_bench.sweep import Sweep

LOG = "log.jsonl"
TAIL_BYTES = 4096
REFRESH_SECONDS = 1.0
SILENCE_SECONDS = 30.0  # without a terminal: whoever reads a log wants to know that it lives
SLOTS_UNKNOWN = 8  # of a queue that takes everything: for the estimate


class Lines:
    """Prints a line when a process starts, ends or fails.

    cells       all runs of the plan, finished ones among them
    finished    those that were finished before
    """

    def __init__(self, cells: list[Cell], finished: list[Cell], estimates: Estimates) -> None:
        self.cells, self.estimates = cells, estimates
        self.states: dict[Cell, str] = dict.fromkeys(cells, "waiting") | dict.fromkeys(finished, "finished")
        self.slots: int | None = None
        self._told = time.monotonic()

    def __enter__(self) -> Lines:
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def started(self, sweep: Sweep, job: Job) -> None:
        """Count and tell."""
        self._mark(job, "running")
        self.tell(f"{self.counted()} started   {job.name}" + (f" (start {job.attempts})" if job.attempts > 1 else ""))

    def ended(self, sweep: Sweep, job: Job, status: str, reason: str, seconds: float) -> None:
        """Count and tell."""
        for cell in job.cells:
            self.states[cell] = sweep.index.row(cell).status
        waiting = {cell for each in sweep.waiting for cell in each.cells}
        self.states |= dict.fromkeys(waiting, "waiting")
        if status == "finished":
            self.estimates.learn(*job.about, seconds)
        left = self.left(sweep)
        told = {"finished": f"in {duration(seconds)}", "again": f"goes on: {reason}"}.get(status, reason)
        line = f"{self.counted()} {status:9} {job.name}: {told}"
        self.tell(line + (f" · about {duration(left)} left" if left is not None and status == "finished" else ""))

    def tick(self, sweep: Sweep) -> None:
        """Say what is running, where nothing was said for half a minute."""
        now = time.monotonic()
        if sweep.running and now - self._told >= SILENCE_SECONDS:
            told = "; ".join(
                f"{job.name}, {duration(now - at)}{_progress(job)}" for job, at, _ in sweep.running.values()
            )
            left = self.left(sweep)
            self.tell(f"{self.counted()} running   {told}" + (f" · about {duration(left)} left" if left else ""))

    def tell(self, line: str) -> None:
        """Print a line."""
        self._told = time.monotonic()
        say(line)

    def counted(self) -> str:
        """`[ 3/12]`, runs that are finished or have failed."""
        over = sum(state in ("finished", "failed") for state in self.states.values())
        return f"[{over:{len(str(len(self.cells)))}}/{len(self.cells)}]"

    def left(self, sweep: Sweep) -> float | None:
        """Seconds that are left, by what is known."""
        now = time.monotonic()
        running = [(job, now - began) for job, began, _ in sweep.running.values()]
        if not sweep.waiting and not running:
            return None
        return self.estimates.left(sweep.waiting, running, sweep.executor.slots or SLOTS_UNKNOWN)

    def _mark(self, job: Job, state: str) -> None:
        for cell in job.cells:
            if self.states[cell] != "finished":
                self.states[cell] = state


class LiveTable(Lines):
    """A table of methods and scenes that changes while the sweep runs; failures are printed above it."""

    def __init__(self, cells: list[Cell], finished: list[Cell], estimates: Estimates, console: Console) -> None:
        super().__init__(cells, finished, estimates)
        self._console = console
        self._live: Live | None = None
        self._drawn = 0.0

    def __enter__(self) -> LiveTable:
        from rich.live import Live

        self._live = Live(console=self._console, auto_refresh=False, transient=True)
        self._live.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        if self._live is not None:
            self._live.__exit__(None, None, None)

    def started(self, sweep: Sweep, job: Job) -> None:
        """Show it."""
        self._mark(job, "running")
        self._draw(sweep)

    def tell(self, line: str) -> None:
        """Print a line above the table, if it is about a failure."""
        if " failed " in line or " again " in line:
            from rich.markup import escape

            self._console.print(escape(line), soft_wrap=True, highlight=False)

    def tick(self, sweep: Sweep) -> None:
        """Draw again, once per second."""
        if time.monotonic() - self._drawn >= REFRESH_SECONDS:
            self._draw(sweep)

    def _draw(self, sweep: Sweep) -> None:
        self._drawn = time.monotonic()
        if self._live is not None:
            self._live.update(self.picture(sweep), refresh=True)

    def picture(self, sweep: Sweep) -> RenderableType:
        """Counts of each method and scene, what is running, and how long the rest takes."""
        from rich.console import Group
        from rich.markup import escape
        from rich.table import Table

        labels = list(dict.fromkeys(cell.label for cell in self.cells))
        scenes = list(dict.fromkeys(cell.scene for cell in self.cells))
        counts: dict[tuple[str, str], Counter[str]] = {}
        for cell, state in self.states.items():
            counts.setdefault((cell.label, cell.scene), Counter())[state] += 1
        table = Table()
        table.add_column("scene", overflow="fold")
        for label in labels:
            table.add_column(escape(label), justify="right", overflow="fold")
        for scene in scenes:
            shown = Path(scene).name or scene
            table.add_row(escape(shown), *(_count(counts.get((label, scene))) for label in labels))
        now = time.monotonic()
        lines = [f"  {escape(job.name)} · {duration(now - began)}{_progress(job)}"
                 for job, began, _ in sweep.running.values()]  # fmt: skip
        left = self.left(sweep)
        total = f"{self.counted()} runs" + (f" · about {duration(left)} left" if left is not None else "")
        return Group(table, *lines, escape(total))


def _count(states: Counter[str] | None) -> str:
    """`3/4`, with failures in red; empty where the plan has no such run."""
    if states is None:
        return ""
    done, all_of_them = states["finished"], sum(states.values())
    text = f"{done}/{all_of_them}"
    colour = "green" if done == all_of_them else "yellow" if states["running"] else "dim"
    return f"[{colour}]{text}[/]" + (f" [red]{states['failed']} failed[/]" if states["failed"] else "")


def _progress(job: Job) -> str:
    """Step of the training that is going on, from the end of its log."""
    for cell in job.cells[:1]:
        try:
            with open(cell.directory / LOG, "rb") as file:
                file.seek(max(0, os.fstat(file.fileno()).st_size - TAIL_BYTES))
                lines = file.read().splitlines()
            steps = [json.loads(line) for line in lines[1:-1]]
            return f" · step {next(x['step'] for x in reversed(steps) if 'step' in x):,}"
        except (OSError, ValueError, KeyError, StopIteration, TypeError):
            return ""
    return ""
