"""Registered schedule tasks that a configuration puts into the plan of a method: `[[tasks]]`."""

from __future__ import annotations

import inspect
import re
import typing
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from pydantic import TypeAdapter, ValidationError

from splatwizard_core.base.values import parse_text
from splatwizard_core.errors import ConfigError, PluginError
from splatwizard_core.plugins import Entry, PluginManager
from splatwizard_core.training.keys import suggest
from splatwizard_core.training.params import AddedTask
from splatwizard_core.training.plan import When, check_when
from splatwizard_core.training.stage import PlannedTask, Stage

_RANGE = re.compile(r"range\(\s*(\d+)\s*(?:,\s*(\d+)\s*)?(?:,\s*(\d+)\s*)?\)")


def add_tasks(stages: Sequence[Stage], tasks: Iterable[AddedTask], plugins: PluginManager) -> list[Stage]:
    """Return the stages of a method with the tasks of a configuration in their plans, after the tasks of their own.

    Raises ConfigError for a task, stage or setting that is not there, with the nearest, and for steps or values that
    make no sense; PluginError for a task that is broken.
    """
    for number, each in enumerate(tasks, 1):
        where = f"tasks, {number}. '{each.name}'"
        names = [stage.name for stage in stages]
        if each.stage and each.stage not in names:
            raise _error(where, f"no stage is called '{each.stage}'", each.stage, names)
        stage = stages[names.index(each.stage) if each.stage else 0]
        planned = PlannedTask(each.before_render, _steps(where, each.steps), _made(where, each, plugins), each.priority)
        stage.added = (*stage.added, planned._replace(name=each.name))
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
    settings = _parsed(where, entry, target, asked.settings)
    if not entry.declared.get("factory"):
        return target
    with plugins.guarding(plugins.tasks, asked.name):
        try:
            return target(**settings)  # type: ignore[no-any-return]
        except ValueError as error:
            raise ConfigError(f"{where}: {error}", key="tasks") from error


def _parsed(where: str, entry: Entry, target: Any, given: dict[str, Any]) -> dict[str, Any]:
    """Return the settings as the parameters of a factory take them."""
    parameters = inspect.signature(target).parameters if entry.declared.get("factory") else {}
    try:
        hints = typing.get_type_hints(target.__init__ if inspect.isclass(target) else target)
    except (NameError, TypeError):  # names for type checkers alone
        hints = {}
    found = {}
    for key, value in given.items():
        if key not in parameters:
            raise _error(where, f"it has no setting '{key}'", key, list(parameters))
        kind = hints.get(key, Any)
        try:
            parsed = parse_text(kind, value) if isinstance(value, str) else value
            found[key] = TypeAdapter(kind).validate_python(parsed)
        except ValueError as error:
            reason = error.errors()[0]["msg"] if isinstance(error, ValidationError) else error
            raise ConfigError(f"{where}: bad value {value!r} for setting '{key}': {reason}", key="tasks") from None
    missing = [name for name, p in parameters.items() if p.default is p.empty and name not in found]
    if missing:
        raise ConfigError(f"{where}: it needs settings {', '.join(missing)}", key="tasks")
    return found


def _error(where: str, problem: str, asked: str, known: list[str]) -> ConfigError:
    near = suggest(asked, known)
    hint = f"did you mean '{near}'?" if near else f"there {'are' if known else 'is none'} {', '.join(known)}".rstrip()
    return ConfigError(f"{where}: {problem}: {hint}", key="tasks")
