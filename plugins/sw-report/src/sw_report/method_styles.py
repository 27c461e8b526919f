"""Colour and marker of each method: the same on every page, whatever else is shown there."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence

from sw_report.charts import MARKERS, STYLES
from sw_report.runs import Run

METHOD_STYLES = STYLES * len(MARKERS)
SALT = "571512"
"""Chosen so that of the published methods no two share colour and marker; of nine that compress volumes and are drawn
together two share a colour, of all at most three, and those that draw or trim surfaces differ in colour."""


def style_of_method(method: str) -> int:
    """Number of a method's style: its colour is the remainder by STYLES, its marker follows (`charts.Series.style`)."""
    return zlib.crc32(f"{SALT}/{method}".encode()) % METHOD_STYLES


def styles_of(runs: Sequence[Run]) -> dict[str, int]:
    """Style of every variant: its method's own; of further variants of a method the same colour with another marker.

    Where a style is taken already, by a method of the same number, the next marker is tried, then the next colour.
    """
    return styles_of_methods({run.variant: run.facts.method for run in runs})


def styles_of_methods(methods: Mapping[str, str]) -> dict[str, int]:
    """Style of every variant of `methods`, variant -> method, as `styles_of` gives it."""
    first = {method: min(variant for variant in methods if methods[variant] == method) for method in methods.values()}
    found: dict[str, int] = {}
    for variant in sorted(methods, key=lambda name: (first[methods[name]] != name, methods[name], name)):
        own = style_of_method(methods[variant])
        tries = [(own % STYLES + shift) % STYLES + (own // STYLES + turn) % len(MARKERS) * STYLES
                 for shift in range(STYLES) for turn in range(len(MARKERS))]  # fmt: skip
        found[variant] = next((style for style in tries if style not in found.values()), own)
    return found
