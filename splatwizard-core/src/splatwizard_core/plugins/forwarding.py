"""Old import paths: packages that have moved stay importable for one release."""

from __future__ import annotations

import importlib
import sys
import warnings
from collections.abc import Mapping

UNTIL = "0.4"


def forward(old: str, new: str, modules: Mapping[str, str]) -> None:
    """Make modules importable below the package `old` as the same objects; warn whoever imports it.

    old      the package that calls this, `__name__`
    new      where its modules are now, for the warning
    modules  last part of the old name -> full name now
    """
    said = f"{old} is {new} now; the old path goes with {UNTIL} (docs/migration.md)"
    warnings.warn(said, DeprecationWarning, stacklevel=3)
    for name, place in modules.items():
        module = importlib.import_module(place)
        sys.modules[f"{old}.{name}"] = module
        setattr(sys.modules[old], name, module)
