"""Lazy re-exports: import a module when one of its public names is first used."""

from __future__ import annotations

import importlib
import sys
import warnings
from collections.abc import Callable, Mapping
from typing import Any


def lazy_exports(
    face: str,
    modules: Mapping[str, str],
    base: Mapping[str, str] | None = None,
    older: Mapping[str, str] | None = None,
) -> tuple[list[str], Callable[[str], Any]]:
    """Make `__all__` and `__getattr__` of the module `face`: a package, or a module directly in it.

    modules     module of the package, without its name -> names to re-export, separated by spaces
    base        the same of modules of this package
    older       the same of the package, of names that are in no `__all__` and go with the next release
    """

    def by_name(package: str, table: Mapping[str, str]) -> dict[str, str]:
        return {name: f"{package}.{module}" for module, names in table.items() for name in names.split()}

    package = face.partition(".")[0]
    homes = by_name(package, modules) | by_name(__name__.partition(".")[0], base or {})
    going = by_name(package, older or {})

    def find(name: str) -> Any:
        """Import a name on first use: a plugin that only registers itself imports no torch."""
        if name in going:
            warnings.warn(f"{face}.{name} goes with 0.4 (docs/migration.md)", DeprecationWarning, stacklevel=2)
        elif name not in homes:
            raise AttributeError(f"module '{face}' has no attribute '{name}'")
        found = getattr(importlib.import_module((homes | going)[name]), name)
        setattr(sys.modules[face], name, found)
        return found

    return list(homes), find
