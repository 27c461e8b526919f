"""Lazy re-exports: import a module when one of its public names is first used."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Mapping
from typing import Any


def lazy_exports(
    face: str, modules: Mapping[str, str], base: Mapping[str, str] | None = None
) -> tuple[list[str], Callable[[str], Any]]:
    """Make `__all__` and `__getattr__` of the module `face`: a package, or a module directly in it.

    modules     module of the package, without its name -> names to re-export, separated by spaces
    base        the same of modules of this package
    """
    tables = ((face.partition(".")[0], modules), (__name__.partition(".")[0], base or {}))
    homes = {
        name: f"{package}.{module}"
        for package, table in tables
        for module, names in table.items()
        for name in names.split()
    }

    def find(name: str) -> Any:
        """Import a name on first use: a plugin that only registers itself imports no torch."""
        if name not in homes:
            raise AttributeError(f"module '{face}' has no attribute '{name}'")
        found = getattr(importlib.import_module(homes[name]), name)
        setattr(sys.modules[face], name, found)
        return found

    return list(homes), find
