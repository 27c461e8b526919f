"""The installed distribution of a class, a function or an object, by the module that defines it."""

from __future__ import annotations

import contextlib
import functools
import importlib.metadata
import inspect
import traceback
from typing import Any

from splatwizard_core.plugins.catalogue import is_ours
from splatwizard_core.plugins.manager import PluginManager

Owner = tuple[str, str]
"""A distribution and its version."""
NOBODY: Owner = ("", "")
_packages = functools.cache(importlib.metadata.packages_distributions)


class Origins:
    """Answers for the modules of plugins and of the core; whatever else is installed is looked up in its metadata."""

    def __init__(self, plugins: PluginManager) -> None:
        self._owners: dict[str, set[Owner]] = {}  # of the modules that are named, and of their top-level packages
        for info in plugins.plugins:
            for module in (info.module, *(entry.target.partition(":")[0] for entry in plugins.provided_by(info))):
                for name in (module, module.partition(".")[0]):
                    self._owners.setdefault(name, set()).add((info.distribution, info.version))

    def of(self, thing: Any) -> Owner:
        """(distribution, version) of a class, a function (or a partial of one), or of the class of an object.

        Empty strings for what belongs to no distribution: a script, a notebook, a file on the path.
        """
        while isinstance(thing, functools.partial):
            thing = thing.func
        if not (inspect.isclass(thing) or inspect.isroutine(thing)):
            thing = type(thing)
        module = getattr(thing, "__module__", None) or ""
        owner = self._of_module(module)
        if owner != NOBODY:
            return owner
        # Several distributions in one namespace, or none that is a plugin.
        found: set[str] = set()
        with contextlib.suppress(Exception):  # the metadata of one of all that is installed cannot be read
            found.update(_packages().get(module.partition(".")[0], ()))
        if len(found) != 1:
            return NOBODY
        distribution = found.pop()
        return distribution, importlib.metadata.version(distribution)

    def _of_module(self, name: str) -> Owner:
        while name:
            owners = self._owners.get(name, set())
            if len(owners) == 1:
                return next(iter(owners))
            name = name.rpartition(".")[0]
        return NOBODY

    def culprit(self, error: BaseException) -> Owner:
        """(distribution, version) of the plugin in whose code an exception came up, the innermost; none of ours."""
        at: BaseException | None = error
        found = NOBODY
        while at is not None:
            for frame, _ in traceback.walk_tb(at.__traceback__):
                owner = self._of_module(frame.f_globals.get("__name__", ""))
                found = found if owner == NOBODY or is_ours(owner[0]) else owner
            at = at.__cause__
        return found
