"""Colour and marker of each method: the same on every page, whatever else is shown there."""

from __future__ import annotations

import zlib
from collections.abc import Sequence

from sw_report.charts import MARKERS, STYLES
from sw_report.runs import Run

LOOKS = STYLES * len(MARKERS)
SALT = "144963"
"""Chosen so that of the published methods no two share colour and marker, and at most three a colour."""


def look_of(method: str) -> int:
    """Number of a method's look: its colour is the remainder by STYLES, its marker follows (`charts.Series.style`)."""
    return zlib.crc32(f"{SALT}/{method}".encode()) % LOOKS


def looks_of(runs: Sequence[Run]) -> dict[str, int]:
    """Look of every variant: its method's own; of further variants of a method the same colour with another marker.

    Where a look is taken already, by a method of the same number, the next marker is tried, then the next colour.
    """
    methods = {run.variant: run.facts.method for run in runs}
    first = {method: min(variant for variant in methods if methods[variant] == method) for method in methods.values()}
    found: dict[str, int] = {}
    for variant in sorted(methods, key=lambda name: (first[methods[name]] != name, methods[name], name)):
        own = look_of(methods[variant])
        tries = [(own % STYLES + shift) % STYLES + (own // STYLES + turn) % len(MARKERS) * STYLES
                 for shift in range(STYLES) for turn in range(len(MARKERS))]  # fmt: skip
        found[variant] = next((look for look in tries if look not in found.values()), own)
    return found
