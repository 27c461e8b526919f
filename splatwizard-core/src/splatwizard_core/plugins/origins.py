"""Which installed distribution a class, a function or an object comes from, by the module that defines it."""

from __future__ import annotations

import functools
import importlib.metadata
import inspect
from collections.abc import Mapping
from typing import Any

from splatwizard_core.plugins.manager import PluginManager

Owner = tuple[str, str]
"""A distribution and its version."""
NOBODY: Owner = ("", "")


class Origins:
    """Answers for the modules of plugins and of the core; whatever else is installed is looked up in its metadata."""

    def __init__(self, plugins: PluginManager) -> None:
        self._modules: dict[str, Owner] = {}
        self._packages: dict[str, set[Owner]] = {}
        for info in plugins.plugins:
            self._add(info.module, (info.distribution, info.version))
            for entry in plugins.provided_by(info):
                self._add(entry.target.partition(":")[0], (info.distribution, info.version))

    def _add(self, module: str, owner: Owner) -> None:
        self._modules[module] = owner
        self._packages.setdefault(module.partition(".")[0], set()).add(owner)

    def of(self, thing: Any) -> Owner:
        """(distribution, version) of a class, a function (or a partial of one), or of the class of an object.

        Empty strings for what belongs to no distribution: a script, a notebook, a file on the path.
        """
        while isinstance(thing, functools.partial):
            thing = thing.func
        if not (inspect.isclass(thing) or inspect.isroutine(thing)):
            thing = type(thing)
        return self.of_module(getattr(thing, "__module__", None) or "")

    def of_module(self, module: str) -> Owner:
        """The same for a module by name."""
        name = module
        while name:
            if name in self._modules:
                return self._modules[name]
            name = name.rpartition(".")[0]
        package = module.partition(".")[0]
        owners = self._packages.get(package, set())
        if len(owners) == 1:
            return next(iter(owners))
        # Several distributions in one namespace, or none that is a plugin.
        found = set(_packages().get(package, ()))
        if len(found) != 1:
            return NOBODY
        name = found.pop()
        return name, importlib.metadata.version(name)


@functools.cache
def _packages() -> Mapping[str, list[str]]:
    return importlib.metadata.packages_distributions()
