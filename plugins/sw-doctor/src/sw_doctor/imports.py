"""`python -m sw_doctor.imports DIST...`: import each distribution's modules and report."""

from __future__ import annotations

import functools
import importlib
import importlib.metadata
import sys

from splatwizard_core.tooling import Check
from sw_doctor.child import serve
from sw_doctor.packages import import_names
from sw_doctor.text import one_line


def import_distribution(name: str) -> list[Check]:
    """Import what a distribution brings; one that is not installed is another check's finding."""
    try:
        modules = import_names(importlib.metadata.distribution(name))
    except importlib.metadata.PackageNotFoundError:
        return []
    try:
        for module in modules:
            importlib.import_module(module)
    except (Exception, SystemExit) as error:
        return [Check("packages", name, "broken", one_line(f"does not import: {type(error).__name__}: {error}"))]
    return [Check("packages", name, "ok", ", ".join(modules))]


if __name__ == "__main__":
    serve((name, functools.partial(import_distribution, name)) for name in sys.argv[1:])
