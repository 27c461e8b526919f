"""Plans: the steps at which tasks run, and how they are scaled, printed and compared."""

from __future__ import annotations

import bisect
import functools
import math
import numbers
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from splatwizard_core.training.tasks import Binding

When = int | range | list[int] | tuple[int, ...] | set[int] | frozenset[int]
"""One step, every step of a range (end excluded), or each listed step once. Step 0 is legal and never fires."""

LISTED_ENTRIES = 6  # longer lists are abbreviated when printed


def check_when(when: Any) -> When:
    """Return `when` itself (lists and sets as copies without duplicates), after checking its form.

    Raises TypeError for a bool, a float, or an iterator (it has no known end); ValueError for a negative step.
    """
    if isinstance(when, range):
        if when.step < 0:
            raise ValueError(f"{when} counts down; a plan's range must count up")
        if when.start < 0:
            raise ValueError(f"{when} starts at a negative step; steps are counted from 1 (0 never fires)")
        return when
    if isinstance(when, list | tuple):
        return list(dict.fromkeys(_step(s) for s in when))
    if isinstance(when, set | frozenset):
        return frozenset(_step(s) for s in when)
    return _step(when)


def _step(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, numbers.Integral):
        raise TypeError(
            f"a plan is an int, a range, or a list, tuple or set of ints; got {value!r} ({type(value).__name__})"
        )
    if value < 0:
        raise ValueError(f"step {value} is negative; steps are counted from 1 (0 never fires)")
    return int(value)


def describe_when(when: When) -> str:
    """Return the registered form, `range(500, 15000, 100)` (with as few arguments as say the same), `7` or `[1, 2]`."""
    if isinstance(when, range) and when.start == 0 and when.step == 1:
        return f"range({when.stop})"
    if isinstance(when, int | range):
        return str(when)
    steps = sorted(when) if isinstance(when, set | frozenset) else list(when)
    shown = [str(s) for s in steps[:LISTED_ENTRIES]]
    return f"[{', '.join([*shown, '...'] if len(steps) > LISTED_ENTRIES else shown)}]"


def scaled(when: When, factor: float) -> When:
    """Return the plan of a shorter or longer run: every bound and interval times `factor`, rounded to the nearest step.

    Intervals are at least 1; what fired at a step > 0 still does; a range that was not empty stays so.
    """
    if factor == 1:
        return when

    def at(step: int) -> int:
        return max(1, math.floor(step * factor + 0.5)) if step > 0 else step

    if isinstance(when, int):
        return at(when)
    if isinstance(when, range):
        start, stop = at(when.start), at(when.stop)
        return range(start, max(stop, start + 1) if when else stop, at(when.step))
    if isinstance(when, set | frozenset):
        return frozenset(at(s) for s in when)
    return list(dict.fromkeys(at(s) for s in when))


@dataclass(frozen=True, eq=False)
class Registration:
    """One registered task.

    stage       "pre" or "post"
    when        the plan as given (scaled, if the run asks for it)
    binding     the task with its arguments resolved
    order       how many registrations came before it
    after       steps up to here are over (registered late); 0 for what stands in the plan
    """

    stage: str
    when: When
    task: Callable[..., Any]
    name: str
    binding: Binding
    priority: int
    order: int
    log: bool = False
    after: int = 0

    @functools.cached_property
    def steps(self) -> Collection[int]:
        """The plan in a form that answers `step in steps` at once; a range is not expanded."""
        if isinstance(self.when, range):
            return self.when
        return frozenset((self.when,) if isinstance(self.when, int) else self.when)

    def due(self, step: int) -> bool:
        return step > self.after and step in self.steps

    def fires_in(self, start: int, total: int | None) -> list[int] | range:
        """Return the steps s at which it runs, start < s <= total (None: no end), ascending."""
        steps = self.steps if isinstance(self.steps, range) else sorted(self.steps)
        first = bisect.bisect_right(steps, max(start, self.after, 0))
        return steps[first : None if total is None else max(first, bisect.bisect_right(steps, total))]


def plan_rows(
    pre: Sequence[Registration], post: Sequence[Registration], *, total: int | None = None, verbose: bool = False
) -> list[dict[str, Any]]:
    """Return the rows of a plan as plain values, in order of execution.

    total       last step T; None: as far as the plans reach
    verbose     also "first", "last" (None: never) and "count": the executions up to T

    A row has "overlaps" if its callable stands in its stage once more and both fire at some step: it runs twice there.
    """
    rows = []
    for title, registrations in (("Pre", pre), ("Post", post)):
        for r in registrations:
            row: dict[str, Any] = {
                "stage": title, "task": r.name, "plan": describe_when(r.when), "priority": r.priority
            }  # fmt: skip
            if any(_overlap(r, other, total) for other in registrations if other is not r):
                row["overlaps"] = True
            if verbose:
                steps = r.fires_in(0, total)
                first, last = (steps[0], steps[-1]) if steps else (None, None)
                row |= {"first": first, "last": last, "count": len(steps)}
            rows.append(row)
    return rows


def _overlap(a: Registration, b: Registration, total: int | None) -> bool:
    if a.task != b.task:
        return False
    few, many = sorted((a.fires_in(0, total), b.fires_in(0, total)), key=len)
    return not set(few).isdisjoint(many)


def format_plan(
    pre: Any, post: Any, total: int | None = None, *, verbose: bool = False, origin: Callable[[Any], str] | None = None
) -> str:
    """Return the plan that will be executed as a table Stage | Task | Plan, one row a registration.

    pre, post   the two schedulers of a stage
    total       last step T; None: as far as the plans reach
    verbose     also first step, last step and number of executions up to T
    origin      (task) -> whose it is, a column of the table if any of them is another package's; "" for the stage's own
    """
    cells = [["Stage", "Task", "Plan", *(["First", "Last", "Runs"] if verbose else [])]]
    for row in plan_rows(pre.registrations, post.registrations, total=total, verbose=verbose):
        plan = f"{row['plan']} (overlaps)" if "overlaps" in row else row["plan"]
        extra = ["-" if row[k] is None else str(row[k]) for k in ("first", "last", "count")] if verbose else []
        cells.append([row["stage"], row["task"], plan, *extra])
    if origin is not None:
        owners = [origin(r.task) for r in (*pre.registrations, *post.registrations)]
        if any(owners):
            cells = [[*line, owner] for line, owner in zip(cells, ["From", *owners], strict=True)]
    widths = [max(len(line[i]) for line in cells) for i in range(len(cells[0]))]
    lines = [" | ".join(c.ljust(w) for c, w in zip(line, widths, strict=True)).rstrip() for line in cells]
    lines.insert(1, "-+-".join("-" * w for w in widths))
    return "\n".join(lines)


def plan_lines(registrations: Sequence[Registration]) -> list[str]:
    """Return lines that identify a plan: stage, name, steps and priority of each registration, in order."""
    lines = []
    for r in registrations:
        # describe_when abbreviates lists; what identifies a plan may not.
        steps = describe_when(r.when) if isinstance(r.when, int | range) else str(sorted(r.when))
        lines.append(f"{r.stage} | {r.name} | {steps} | priority {r.priority}")
    return lines
