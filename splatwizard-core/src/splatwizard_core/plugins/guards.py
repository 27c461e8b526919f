"""Hook implementations of a plugin, each wrapped so that one that fails harms nobody but its own plugin."""

from __future__ import annotations

import contextlib
import functools
import inspect
import json
import sys
from collections.abc import Callable, Generator, Iterable
from contextlib import AbstractContextManager
from typing import Any

import pluggy

from splatwizard_core.errors import PluginError

Guard = Callable[[str, Iterable[Any]], AbstractContextManager[None]]
"""(hook, arguments) -> a context that takes any exception of the implementation."""


def prints_to_stderr() -> AbstractContextManager[Any]:
    """In the block, what a stranger prints does not stand in the output of a command."""
    return contextlib.redirect_stdout(sys.stderr)


class GuardedHooks:
    """Stands for a plugin's module in pluggy: its hook implementations as attributes."""

    def __dir__(self) -> list[str]:
        return [*vars(self)]  # pluggy looks at each name


def guarded_hooks(module: Any, manager: pluggy.PluginManager, guard: Guard) -> GuardedHooks:
    """The hook implementations of `module`, with their names and options, each call inside `guard`."""
    found = GuardedHooks()
    for name in dir(module):
        options = None if name.startswith("__") else manager.parse_hookimpl_opts(module, name)
        if options is None:
            continue
        wraps = options.get("wrapper") or options.get("hookwrapper")
        protect = _guarded_wrapper if wraps else _guarded
        setattr(found, name, protect(getattr(module, name), options.get("specname") or name, guard))
    return found


def _guarded(function: Callable[..., Any], hook: str, guard: Guard) -> Callable[..., Any]:
    @functools.wraps(function)  # pluggy reads options and argument names off it
    def call(*arguments: Any, **keywords: Any) -> Any:
        with guard(hook, [*arguments, *keywords.values()]):
            found = function(*arguments, **keywords)
            if hook == "describe_scene":  # it may only return what can be printed
                json.dumps({**(found or {})}, allow_nan=False)
            return found

    return call


def _guarded_wrapper(function: Callable[..., Any], hook: str, guard: Guard) -> Callable[..., Any]:
    @functools.wraps(function)
    def call(*arguments: Any, **keywords: Any) -> Generator[None, Any, Any]:
        inner = None
        with guard(hook, [*arguments, *keywords.values()]):
            inner = function(*arguments, **keywords)
            next(inner)
        failed = inner is None or inspect.getgeneratorstate(inner) != inspect.GEN_SUSPENDED
        result = yield  # what the other implementations return
        if failed:
            return result
        with guard(hook, [*arguments, *keywords.values()]):  # what it adds now is its own too
            try:
                inner.send(result)
            except StopIteration as end:
                return end.value
        return result

    return call


def one_line(error: BaseException) -> str:
    """An exception as one line: its own text for an error that is meant for users, else with its type before it."""
    try:
        reason = str(error) if isinstance(error, PluginError) else f"{type(error).__name__}: {error}"
    except Exception:  # a stranger's __str__
        reason = type(error).__name__
    return " ".join(reason.split())
