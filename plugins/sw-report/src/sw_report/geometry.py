"""The geometry of one run on its page: what its values consist of, and the pictures that were kept of it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sw_report.blocks import Part, Row, Table, columns, row
from sw_report.declared import metric_style
from sw_report.facts import clean
from sw_report.pictures import LONGEST_SIDE, Gallery, Shown, ViewRow, encode
from sw_report.results_tables import plain
from sw_report.runs import Run
from sw_report.truth import RENDERS, read_png

FOLDER = "geometry"
"""Folder in that of the renders where an evaluation keeps what shows the geometry."""
MOST_PICTURES = 4


def geometry_parts(run: Run, *, pictures: bool) -> list[Part]:
    """Pictures, and a table of the values with their protocols; empty for a run without geometry."""
    if not run.facts.geometry:
        return []
    found = [Part(table=_values_table(run.facts.geometry))]
    shown = _pictures(run) if pictures else []
    return [Part(gallery=Gallery(shown)), *found] if shown else found


def _values_table(geometry: Mapping[str, Mapping[str, Any]]) -> Table:
    """One row per value; what a mesh was made with goes into a note."""
    rows: list[Row] = []
    notes = []
    for metric, details in geometry.items():
        label, protocol, unit = metric_style(metric).label, plain(details.get("protocol")), details.get("unit")
        for name, value in details.items():
            if isinstance(value, Mapping):
                notes.append(f"{label}, {clean(str(name))}: {plain(dict(value))}.")
            elif name not in ("protocol", "unit"):
                rows.append(
                    row([label, clean(str(name)).replace("_", " "), _spelt(value), plain(unit or "-"), protocol])
                )
    heads = ["metric", "part", "value", "unit", "protocol"]
    return Table("Geometry", columns(heads, text=("metric", "part", "unit", "protocol")), rows, notes=notes)


def _spelt(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else plain(value)


def _pictures(run: Run) -> list[ViewRow]:
    """The PNG files of the folder, by name; what cannot be read is left out."""
    folder = run.directory / RENDERS / FOLDER
    found = []
    for path in sorted(folder.glob("*.png"))[:MOST_PICTURES]:
        try:
            picture = encode(read_png(path), LONGEST_SIDE)
        except (OSError, ValueError):
            continue
        found.append(ViewRow(clean(path.stem), None, [Shown(run, None, picture, None)]))
    return found
