"""The one progress display: a bar with rate, loss, Gaussian count and ETA on a terminal, plain lines elsewhere.

Everything goes to stderr, so that stdout stays clean for results and `--json`.
"""

from __future__ import annotations

import contextlib
import sys
import time
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any, TextIO

if TYPE_CHECKING:
    from rich.progress import Progress

REFRESH_SECONDS = 0.1  # a bar is redrawn at most ten times a second
LINE_SECONDS = 5.0  # a plain line appears at most this often
FORETOLD_AFTER_SECONDS = 4.0  # of measuring, and FORETOLD_AFTER_STEPS, before it is said how long all will take
FORETOLD_AFTER_STEPS = 3
LONG_SECONDS = 120.0  # from here on that is worth a line
RATE_WINDOW_SECONDS = 20.0  # the rate is that of the last seconds: models grow while they train

# Nested displays share the outer one's screen lines.
_display: ContextVar[Progress | None] = ContextVar("splatwizard_progress", default=None)


class Bar:
    """The progress of one step, as plain lines. `advance` is cheap: it draws only when enough time has passed.

    label   what is being done
    total   steps in all; None if unknown
    start   steps done before (a resumed run); they do not count for the rate
    foretells   a line says how long it will take, from the first steps, if that is long
    """

    _interval = LINE_SECONDS

    def __init__(
        self, label: str, total: int | None, start: int, *, unit: str, stream: TextIO, foretells: bool = False
    ) -> None:
        self.label, self.total, self.unit = label, total, unit
        self._foretells = foretells and total is not None
        self._measured_from: tuple[float, int] | None = None
        self.done = start
        self._stream = stream
        self._fields: dict[str, Any] = {}
        self._drawn = time.monotonic()
        self._began = (self._drawn, start)
        self._marks = deque([self._began])
        self._lines = 0

    def advance(self, steps: int = 1, **fields: Any) -> None:
        """Count `steps` and remember what to show beside them.

        fields  loss=..., gaussians=..., or any name: numbers or one-element tensors, read only when drawn
        """
        self.done += steps
        self._fields.update(fields)
        now = time.monotonic()
        if self._foretells:
            self._foretell(now)
        if now - self._drawn < self._interval:
            return
        self._drawn = now
        self._marks.append((now, self.done))
        while len(self._marks) > 2 and now - self._marks[1][0] > RATE_WINDOW_SECONDS:
            self._marks.popleft()
        left = self.seconds_left
        self._show(f"{duration(left)} left" if left else "")

    def _foretell(self, now: float) -> None:
        """Say once how long the rest will take, if that is long; the first step, which warms up, does not count."""
        if self._measured_from is None:
            self._measured_from = (now, self.done)
        seconds, steps = now - self._measured_from[0], self.done - self._measured_from[1]
        if seconds < FORETOLD_AFTER_SECONDS or steps < FORETOLD_AFTER_STEPS or self.total is None:
            return
        self._foretells = False
        left = (self.total - self.done) * seconds / steps
        if left >= LONG_SECONDS:
            self.say(
                f"{self.label}: about {duration(left)} for the {self.total - self.done:,} steps that are left, by the "
                f"{steps:,} just measured (more as a model grows)"
            )

    def say(self, line: str) -> None:
        """Print a line for the user, above the bar on a terminal."""
        with contextlib.suppress(OSError):  # a terminal that has closed must not end the work
            print(line, file=self._stream, flush=True)

    def finish(self) -> None:
        """Show the rate of the whole, and how long it took."""
        self._marks = deque([self._began])
        self._show(f"in {duration(time.monotonic() - self._began[0])}", finished=True)

    @property
    def rate(self) -> float | None:
        """Steps per second over the last seconds, or None before the first step."""
        (t0, n0), now = self._marks[0], time.monotonic()
        return (self.done - n0) / (now - t0) if self.done > n0 and now > t0 else None

    @property
    def seconds_left(self) -> float | None:
        rate = self.rate
        return None if self.total is None or not rate else max(self.total - self.done, 0) / rate

    def facts(self) -> str:
        """Rate and fields: `8.1 it/s · loss 0.0345 · 120,331 Gaussians`."""
        shown, rate = [_shown(name, value) for name, value in self._fields.items()], self.rate
        if rate is not None:
            shown.insert(0, f"{rate:.1f} {self.unit}/s" if rate >= 0.1 else f"{1 / rate:.0f} s/{self.unit}")
        return " · ".join(shown)

    def _show(self, time_told: str, *, finished: bool = False) -> None:
        if finished:
            if self._lines == 0 and time.monotonic() - self._began[0] < 1.0:
                return  # a line for each blink of an eye is noise
            parts = [f"{self.label}: {self.done:,} {time_told}", self.facts()]
        else:
            count = f"{self.done:,}" if self.total is None else f"{self.done:,}/{self.total:,}"
            parts = [f"{self.label}: {count}", self.facts(), time_told]
        self.say(" · ".join(p for p in parts if p))
        self._lines += 1


class _RichBar(Bar):
    """The same on a terminal."""

    _interval = REFRESH_SECONDS

    def __init__(
        self, display: Progress, label: str, total: int | None, start: int, *, unit: str, foretells: bool = False
    ) -> None:
        super().__init__(label, total, start, unit=unit, stream=sys.stderr, foretells=foretells)
        self._display = display
        self.task = display.add_task(label, total=total, completed=start, facts="", left="")

    def _show(self, time_told: str, *, finished: bool = False) -> None:
        with contextlib.suppress(OSError):
            self._display.update(self.task, completed=self.done, facts=self.facts(), left=time_told, refresh=True)


@contextmanager
def track(
    label: str, *, total: int | None = None, start: int = 0, unit: str = "it", stream: TextIO | None = None,
    foretells: bool = False,
) -> Iterator[Bar]:  # fmt: skip
    """Show the progress of one long step.

        with track("train", total=7000, start=1200) as bar:
            bar.advance(1, loss=0.03, gaussians=120_331)

    label   what is being done
    total   steps in all, `start` included; None if unknown
    start   steps that an earlier run did
    unit    of the rate: "it", "views"
    stream  where to (default: stderr)
    foretells   after the first seconds a line says how long the whole will take, if that is two minutes or more
    """
    out, outer = stream or sys.stderr, _display.get()
    if not out.isatty():
        bar = Bar(label, total, start, unit=unit, stream=out, foretells=foretells)
        yield bar
        bar.finish()
    elif outer is not None:
        nested = _RichBar(outer, label, total, start, unit=unit, foretells=foretells)
        try:
            yield nested
        finally:
            outer.remove_task(nested.task)
    else:
        with _new_display(out) as display:
            bar = _RichBar(display, label, total, start, unit=unit, foretells=foretells)
            yield bar
            bar.finish()


@contextmanager
def _new_display(out: TextIO) -> Iterator[Progress]:
    """The display that bars share until the outermost of them ends."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=24),
        MofNCompleteColumn(),
        TextColumn("{task.fields[facts]}", markup=False),
        TextColumn("{task.fields[left]}", style="cyan", markup=False),
    )
    with Progress(*columns, console=Console(file=out), auto_refresh=False) as display:
        token = _display.set(display)
        try:
            yield display
        finally:
            _display.reset(token)


def _shown(name: str, value: Any) -> str:
    if name == "gaussians":
        return f"{int(value):,} Gaussians"
    if isinstance(value, str):
        return f"{name} {value}"
    return f"{name} {value:,}" if isinstance(value, int) else f"{name} {float(value):.4g}"


def duration(seconds: float) -> str:
    """`12.3 s`, `4 min 05 s`, `2 h 03 min`."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"


def counted(counts: Mapping[str, int]) -> str:
    """`120,331 gaussians`, of all that a model counts."""
    return ", ".join(f"{n:,} {name.removeprefix('num_')}" for name, n in counts.items())


def several(count: int, noun: str) -> str:
    """`1 view`, `1,200 views`."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"
