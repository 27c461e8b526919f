"""Sweeps: the index that `sw bench` leaves in its folder tells which runs of a plan failed, and which are missing.

The index may come from anybody: what it says is shown as text, and opens no file. docs/bench.md describes it.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Collection
from contextlib import closing
from pathlib import Path

from sw_report.facts import clean

FILE_NAME = "bench.sqlite"
SCHEMA = "1"
MOST_NAMED = 20  # failures in the notes
MOST_CHARACTERS = 300  # of a reason
MOST_RUNS = 100_000
MOST_WORK = 5_000_000  # steps of SQLite's machine, under a second
Row = tuple[str, str, str, str, str, str, str]
"""label, scene, seed, rate, directory below the folder, status, reason."""


def is_sweep(root: Path) -> bool:
    """Whether `sw bench` has begun a sweep in a folder."""
    return (root / FILE_NAME).is_file()


def sweep_notes(root: Path, records: Collection[Path]) -> list[str]:
    """Return a line for each failed run of the sweep in a folder, and lines about what it lacks and has besides.

    records     of the runs that were found below the folder
    """
    path = root / FILE_NAME
    if not path.is_file():
        return []
    shown = clean(str(root))
    try:
        rows = _rows(path)
    except (sqlite3.Error, ValueError) as error:
        return [f"{shown}: its index of a sweep, {FILE_NAME}, cannot be read: {clean(str(error))}"]
    failed = [f"failed: {label} on {scene}, seed {seed}, {rate}: {reason}"
              for label, scene, seed, rate, _, status, reason in rows if status == "failed"]  # fmt: skip
    notes = failed[:MOST_NAMED]
    if len(failed) > MOST_NAMED:
        notes.append(f"{len(failed) - MOST_NAMED} more runs of the sweep in {shown} failed: see {FILE_NAME}")
    waiting = sum(row[5] not in ("failed", "finished") for row in rows)
    if waiting:
        notes.append(f"{waiting} of {len(rows)} runs of the sweep in {shown} are not finished: `sw bench` goes on")
    planned = {row[4] for row in rows}
    besides = [each for each in records if each.parent.relative_to(root).as_posix() not in planned]
    if besides:
        notes.append(f"{len(besides)} runs in {shown} are not of the plan of its sweep")
    return notes


def _rows(path: Path) -> list[Row]:
    """Return the runs of an index. Raises sqlite3.Error or ValueError for a file that is none."""
    with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as file:
        file.set_progress_handler(lambda: 1, MOST_WORK)  # a view may ask for more than it shows
        file.text_factory = lambda raw: raw.decode(errors="replace")
        schema = file.execute("SELECT value FROM sweep WHERE key = 'schema'").fetchone()
        if schema is None or schema[0] != SCHEMA:
            raise ValueError("it is of another release")
        found = file.execute("SELECT label, scene, seed, rate, directory, status, reason FROM runs ORDER BY rowid")
        rows = found.fetchmany(MOST_RUNS)
    return [tuple(clean(str(value))[:MOST_CHARACTERS] for value in row) for row in rows]  # type: ignore[misc]
