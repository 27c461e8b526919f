"""Best values of a table's columns: quality, size and speed, where values may be compared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from sw_report.blocks import Row


def marked_values(values: Sequence[float | None], direction: str) -> set[int]:
    """Places of the best values, equal ones too; none where all are best, and without a direction.

    direction   "higher" or "lower": what is better
    """
    known = [value for value in values if value is not None]
    if not known or direction not in ("higher", "lower"):
        return set()
    top = max(known) if direction == "higher" else min(known)
    found = {i for i, value in enumerate(values) if value == top}
    return found if len(found) < len(values) else set()


def marked(rows: Sequence[Row], columns: Mapping[int, tuple[Sequence[float | None], str]]) -> list[Row]:
    """Mark the best cells of some columns.

    columns     index of the column -> its values row by row, and their direction, as of `marked_values`
    """
    best = {column: marked_values(values, direction) for column, (values, direction) in columns.items()}
    return [
        replace(row, cells=[replace(c, best=True) if i in best.get(j, ()) else c for j, c in enumerate(row.cells)])
        for i, row in enumerate(rows)
    ]
