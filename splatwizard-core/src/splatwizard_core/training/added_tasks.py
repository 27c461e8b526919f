"""Schedule tasks that a configuration adds to a method's plan: `[[tasks]]`."""

from __future__ import annotations

import inspect
import re
import typing
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from pydantic import ConfigDict, create_model

from splatwizard_core.errors import ConfigError, PluginError
from splatwizard_core.plugins import PluginManager
from splatwizard_core.plugins.registry import nearest
from splatwizard_core.training.overrides import apply_overrides
from splatwizard_core.training.params import AddedTask
from splatwizard_core.training.plan import When, check_when
from splatwizard_core.training.stage import PlannedTask, Stage

_RANGE = re.compile(r"range\(\s*(\d+)\s*(?:,\s*(\d+)\s*)?(?:,\s*(\d+)\s*)?\)")


def add_tasks(stages: Sequence[Stage], tasks: Iterable[AddedTask], plugins: PluginManager) -> list[Stage]:
    """Return a method's stages with the configured tasks added to their plans, after the stages' own tasks.

    Raises ConfigError for invalid steps or values, and for an unknown task, stage or setting, with the nearest name.
    Raises PluginError for a task that is broken.
    """
    for number, each in enumerate(tasks, 1):
        where = f"tasks, {number}. '{each.name}'"
        names = [stage.name for stage in stages]
        if each.stage and each.stage not in names:
            near = nearest("stage", each.stage, names)
            raise ConfigError(f"{where}: no stage is called '{each.stage}': {near}", key="tasks")
        stage = stages[names.index(each.stage) if each.stage else 0]
        planned = PlannedTask(each.before_render, _steps(where, each.steps), _made(where, each, plugins), each.priority)
        stage.extra_tasks = (*getattr(stage, "extra_tasks", ()), planned._replace(name=each.name))
    return list(stages)


def _steps(where: str, steps: int | list[int] | str) -> When:
    try:
        if not isinstance(steps, str):
            return check_when(steps)
        found = _RANGE.fullmatch(steps.strip())
        if found is None:
            raise ValueError(f"'{steps}' is neither a step, a list of steps, nor range(first, end, every)")
        return check_when(range(*(int(bound) for bound in found.groups() if bound is not None)))
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{where}: steps: {error}", key="tasks") from None


def _made(where: str, asked: AddedTask, plugins: PluginManager) -> Callable[..., Any]:
    """Return the task with its settings."""
    try:
        entry = plugins.tasks.entry(asked.name)
        target = plugins.tasks.load(asked.name)
    except PluginError as error:
        if error.name is None:  # it is there, but broken or claimed twice
            raise
        raise ConfigError(f"{where}: {error}", key="tasks") from error
    if not entry.declared.get("factory"):
        if asked.settings:
            raise ConfigError(f"{where}: it has no settings: leave them out", key="tasks")
        return target
    with plugins.guarding(plugins.tasks, asked.name):
        try:
            return target(**_parsed(where, target, asked.settings))  # type: ignore[no-any-return]
        except ValueError as error:
            raise ConfigError(f"{where}: {error}", key="tasks") from error


def _parsed(where: str, factory: Any, given: dict[str, Any]) -> dict[str, Any]:
    """Parse settings by the parameter types of a factory."""
    try:
        hints = typing.get_type_hints(factory.__init__ if inspect.isclass(factory) else factory)
    except (NameError, TypeError):  # names for type checkers alone
        hints = {}
    fields: dict[str, Any] = {
        name: (hints.get(name, Any), ... if p.default is p.empty else p.default)
        for name, p in inspect.signature(factory).parameters.items()
    }
    settings = create_model("Settings", __config__=ConfigDict(arbitrary_types_allowed=True), **fields)
    found = apply_overrides(settings.model_construct(), given, source=where)
    return {name: getattr(found, name) for name in given}
