"""The schedule of one stage: tasks registered for steps, run in order of priority, supplied by type annotation."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from dataclasses import replace
from operator import attrgetter
from typing import Any, Final

import torch

from splatwizard_core.errors import EmptyModel, TaskError, TaskSignatureError, TrainingDiverged
from splatwizard_core.training.params import PipelineParams
from splatwizard_core.training.plan import Registration, When, check_when, format_plan, plan_lines
from splatwizard_core.training.stage import Stage
from splatwizard_core.training.tasks import POST_ONLY, SOURCES, TaskContext, bind

__all__ = ["STOP", "Scheduler", "build_schedulers", "format_plan"]


class _Stop:
    def __repr__(self) -> str:
        return "STOP"


STOP: Final = _Stop()
"""Returned by a task to end its training stage cleanly after the current step."""


class Scheduler:
    """The tasks that run before rendering ("pre") or between backward and the optimizer step ("post").

    stage   "pre" or "post"
    registrations   in order of execution
    """

    STOP: Final = STOP

    def __init__(self, stage: str) -> None:
        if stage not in ("pre", "post"):
            raise ValueError(f"a scheduler's stage is 'pre' or 'post', not '{stage}'")
        self.stage = stage
        self.registrations: list[Registration] = []
        self._step: int | None = None  # while a step's tasks run

    def register_task(
        self, when: When, task: Callable[..., Any], *, priority: int = 0, name: str | None = None, log: bool = False
    ) -> None:
        """Run `task` at the steps of `when`.

        when        one step, a range (end excluded), or a list, tuple or set of steps; step 0 never fires
        task        its parameters are supplied by their annotations (`tasks.TaskContext` holds what there is);
                    it may return STOP, other return values are ignored
        priority    lower runs earlier; equal ones in order of registration
        name        in plans, logs and errors; default: the function's name with spaces
        log         a line in log.jsonl each time it runs

        A task may register others while it runs: they fire at later steps only.
        Raises TypeError or ValueError for a bad `when`, TaskSignatureError for a parameter that cannot be supplied.
        """
        plan = check_when(when)
        name = task_name(task) if name is None else name
        binding, order = bind(task, self.stage, name), len(self.registrations)
        entry = Registration(self.stage, plan, task, name, binding, priority, order, log, self._step or 0)
        # A new list: exec may be iterating over the old one.
        self.registrations = sorted([*self.registrations, entry], key=_order)

    def reprioritise(self, kind: type, priority: int) -> None:
        """Give all registered tasks that are instances of `kind` another priority.

        So a stage that wraps another one makes room between the tasks that it has taken over.
        """
        changed = [replace(e, priority=priority) if isinstance(e.task, kind) else e for e in self.registrations]
        self.registrations = sorted(changed, key=_order)

    def check(self, context: TaskContext) -> None:
        """Raise TaskSignatureError early for arguments that would fail at the task's first step."""
        for entry in self.registrations:
            entry.binding.check(context, skip=(*POST_ONLY, "scheduler"))

    def exec(self, step: int, context: TaskContext) -> bool:
        """Run the tasks due at `step`; return whether one asked to stop. No-op past the end of all plans.

        Raises TaskError that names the task, the cause chained.
        """
        stop = False
        for entry in self.registrations:
            if not entry.due(step):
                continue
            context.step, context.scheduler, context.log.task, self._step = step, self, entry.name, step
            try:
                result = entry.binding(context)
            except (EmptyModel, TrainingDiverged, TaskSignatureError, torch.cuda.OutOfMemoryError):
                raise
            except (Exception, SystemExit) as error:
                raise TaskError(self.stage, step, entry.name, error) from error
            finally:
                self._step = None
            stop = stop or result is STOP
            if entry.log:
                context.log.say("")
        return stop

    def pending_late(self, step: int) -> bool:
        """Return whether a task registered by another task is still to run after `step`.

        A checkpoint cannot hold it, so none is written until it has run: a resumed run repeats the registration.
        """
        return any(e.after > 0 and e.fires_in(step, None) for e in self.registrations)

    def plan_lines(self) -> list[str]:
        """Return lines that identify the plan, without tasks registered by running tasks."""
        return plan_lines([e for e in self.registrations if e.after == 0])


SOURCES[Scheduler] = "scheduler"

_order = attrgetter("priority", "order")


def build_schedulers(stage: Stage, ppl: PipelineParams) -> tuple[Scheduler, Scheduler]:
    """Return the plan of a stage, (pre, post), without scene, model or device: what is printed is what is run."""
    pre, post = Scheduler("pre"), Scheduler("post")
    stage.register_pre_task(pre, ppl, stage.opt)
    stage.register_post_task(post, ppl, stage.opt)
    for each in getattr(stage, "extra_tasks", ()):  # one that calls no __init__ of ours has none
        (pre if each.before_render else post).register_task(
            each.when, each.task, priority=each.priority, name=each.name
        )
    return pre, post


def task_name(task: Callable[..., Any]) -> str:
    """Return the name of a function (also inside a partial) with spaces, or of a callable object's class."""
    while isinstance(task, functools.partial):
        task = task.func
    named = inspect.isroutine(task) or inspect.isclass(task)
    name: str = getattr(task, "__name__", "") if named else type(task).__name__
    return name.strip("_").replace("_", " ") or "task"
