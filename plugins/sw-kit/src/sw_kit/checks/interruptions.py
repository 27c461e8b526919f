"""Steps after which the resume check interrupts a training: chosen from the plan, where state could be lost."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from splatwizard_core.tooling import build_schedulers

if TYPE_CHECKING:
    from splatwizard_core.api import PipelineParams, Stage
    from splatwizard_core.tooling import Entry

MOST = 4


def stops_of(stages: Sequence[Stage], ppl: PipelineParams, entry: Entry) -> list[int]:
    """Return at most 4 steps, counted over all stages, ascending: the middle, and those around firings of tasks.

    Of each task one stop lies between two of its firings and one before its first, since what it keeps outside the
    model is lost there. Tasks of the method's own package come first, then those that fire seldom. A training of less
    than two steps has no stop.
    """
    package, total = entry.target.partition(":")[0].partition(".")[0], sum(stage.iterations for stage in stages)
    wanted: list[tuple[bool, int, list[int]]] = []
    before = 0
    for stage in stages:
        for scheduler in build_schedulers(stage, ppl):
            for each in scheduler.registrations:
                fires = each.fires_in(0, stage.iterations)
                if fires:
                    foreign = package not in {name.partition(".")[0] for name in _modules(each.task)}
                    wanted.append((foreign, len(fires), [before + step for step in around(fires)]))
        before += stage.iterations
    found = dict.fromkeys([total // 2, *(step for _, _, steps in sorted(wanted) for step in steps)])
    return sorted([step for step in found if 0 < step < total][:MOST])


def around(fires: Sequence[int]) -> list[int]:
    """Return the step in the middle of the middle two firings, and the one before the first."""
    if len(fires) < 2:
        return [fires[0] - 1]
    second = len(fires) // 2
    return [(fires[second - 1] + fires[second]) // 2, fires[0] - 1]


def _modules(task: Any) -> set[str]:
    """Return the modules that a task's function, or the class of the object that it belongs to, are of."""
    while isinstance(task, functools.partial):
        task = task.func
    owner = getattr(task, "__self__", task)
    return {getattr(task, "__module__", None) or "", type(owner).__module__}
