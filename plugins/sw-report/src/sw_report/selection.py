"""Columns of a table that somebody chose, and the notes that are about these."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from dataclasses import replace

import click

from sw_report.blocks import Note, Table
from sw_report.numbers import is_lpips

PAPER = ("method", "rate", "psnr", "ssim", "lpips", "size")
"""Columns of a paper's table; of several forms of LPIPS the field's own."""
LPIPS = "lpips"
KNOWN = (*PAPER, "scenes", "seeds", "primitives", "steps", "train", "encode", "decode", "fps")
"""Columns that are no metrics, besides the usual metrics; any metric is one by its name."""


ALIASES = {
    "bytes": "size", "mb": "size", "gaussians": "primitives", "anchors": "primitives", "iterations": "steps",
    "seconds": "train", "time": "train",
}  # fmt: skip
"""Other words for columns, as heads and records have them."""


def names_columns(words: str | None) -> bool:
    """Whether `--columns` names columns, which may then be diagnostic metrics, of which tables have none else."""
    return words is not None and words.strip().lower() not in ("all", "paper")


def chosen_columns(words: str | None, tables: Sequence[Table], *, default: Sequence[str] | None) -> list[str] | None:
    """Return the keys that `--columns` names: "all" is None, "paper" that set, None the default.

    Raises click.UsageError for a name that is no column of any table.
    """
    if words is None:
        return None if default is None else list(default)
    names = [word.strip().lower() for word in words.split(",") if word.strip()]
    if names == ["all"]:
        return None
    names = [name for word in names for name in (PAPER if word == "paper" else (ALIASES.get(word, word),))]
    there = {column.key.lower() for table in tables for column in table.columns if column.key}
    wrong = [name for name in names if name not in there and name not in KNOWN]
    if wrong or not names:
        known = list(dict.fromkeys([*sorted(there), LPIPS, "all", "paper"]))
        near = difflib.get_close_matches(wrong[0], [*known, *ALIASES], 1) if wrong else []
        hint = f"did you mean '{near[0]}'? It knows" if near else "one or more of"
        told = f"has no '{wrong[0]}'" if wrong else "is empty"
        raise click.UsageError(f"--columns {told}: {hint} {', '.join(known)}")
    return names


def selected(table: Table, keys: Iterable[str] | None) -> Table:
    """Return the table with these columns, in their order, and the notes that are about them; None: all.

    A table whose columns have no keys stays as it is. "lpips" is the first form of it that the table has.
    """
    if keys is None or not any(column.key for column in table.columns):
        return table
    places = {column.key.lower(): i for i, column in enumerate(table.columns) if column.key}
    lpips = next((i for key, i in places.items() if is_lpips(key)), None)
    if lpips is not None:
        places.setdefault(LPIPS, lpips)
    kept = list(dict.fromkeys([0, *(places[key] for key in keys if key in places)]))  # the first names the rows
    shown = {table.columns[i].key for i in kept}
    return replace(
        table,
        columns=[table.columns[i] for i in kept],
        rows=[replace(row, cells=[row.cells[i] for i in kept]) for row in table.rows],
        notes=[n for n in table.notes if not isinstance(n, Note) or not n.about or n.about & shown],
    )
