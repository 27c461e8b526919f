"""Lazy re-exports: import a module when one of its public names is first used."""

from __future__ import annotations

import importlib
import re
import sys
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

LENT = re.compile(r"^from (\S+) import (\w+) as \2$", re.MULTILINE)


def lazy_exports(face: str, older: Mapping[str, str] | None = None) -> tuple[list[str], Callable[[str], Any]]:
    """Make `__all__` and `__getattr__` of the module `face` from its stub: lines `from MODULE import NAME as NAME`.

    older   module -> names, separated by spaces, that are in no `__all__` and go with the next release
    """
    stub = Path(str(sys.modules[face].__file__)).with_suffix(".pyi")
    homes = {name: home for home, name in LENT.findall(stub.read_text("utf-8"))} if stub.is_file() else {}
    going = {name: home for home, names in (older or {}).items() for name in names.split()}

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
