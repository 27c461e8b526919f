"""The index of a sweep, one SQLite file in its output folder: every run of the plan, its state, and why it failed.

The run directories hold the results; the index says what belongs to the plan and what became of it. Only the process
that runs the sweep writes it. docs/bench.md describes the tables.
"""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path

from splatwizard_core.api import UserInputError
from sw_bench.cells import Cell

FILE_NAME = "bench.sqlite"
SCHEMA = 1
ONE_RUN = "label = ? AND scene = ? AND seed = ? AND rate = ?"
TABLES = """
CREATE TABLE IF NOT EXISTS sweep (key TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS runs (
    label TEXT NOT NULL, method TEXT NOT NULL, scene TEXT NOT NULL, seed INTEGER NOT NULL, rate TEXT NOT NULL,
    preset TEXT NOT NULL, directory TEXT NOT NULL, config_hash TEXT NOT NULL, status TEXT NOT NULL,
    reason TEXT NOT NULL DEFAULT '', attempts INTEGER NOT NULL DEFAULT 0, seconds REAL NOT NULL DEFAULT 0,
    place TEXT NOT NULL DEFAULT '', command TEXT NOT NULL DEFAULT '', log TEXT NOT NULL DEFAULT '',
    changed TEXT NOT NULL, PRIMARY KEY (label, scene, seed, rate)
);
CREATE TABLE IF NOT EXISTS jobs (
    name TEXT NOT NULL, label TEXT NOT NULL, scene TEXT NOT NULL, runs INTEGER NOT NULL, status TEXT NOT NULL,
    seconds REAL NOT NULL, place TEXT NOT NULL, ended TEXT NOT NULL
);
"""


@dataclass(frozen=True)
class Row:
    """State of one run.

    status  waiting, running, finished or failed
    reason  of a failure, one line
    """

    status: str
    reason: str


class Index:
    """The index file of a sweep; raises UserInputError where the file is none."""

    def __init__(self, out: Path) -> None:
        self.path, self._out = out / FILE_NAME, out
        try:
            # autocommit: but for blocks of `together`, each change is on the disk before the next thing happens
            self._file = sqlite3.connect(self.path, isolation_level=None)
            self._file.executescript(TABLES)
            self._file.execute("INSERT OR IGNORE INTO sweep VALUES ('schema', ?)", (str(SCHEMA),))
            schema = self.get("schema")
        except sqlite3.Error as error:
            raise UserInputError(f"{self.path}: {error}: move it away, and it is made anew from the runs") from None
        if schema != str(SCHEMA):
            raise UserInputError(f"{self.path} is of another release (schema {schema}): use another --out")

    @contextmanager
    def together(self) -> Iterator[None]:
        """Bring the changes of the block to the disk at once, at its end, however it ends.

        Each change alone waits for the disk, and beside trainings that write checkpoints that takes long.
        """
        self._file.execute("BEGIN")
        try:
            yield
        finally:
            self._file.execute("COMMIT")

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def get(self, key: str) -> str | None:
        """Return a fact of the sweep."""
        found = self._file.execute("SELECT value FROM sweep WHERE key = ?", (key,)).fetchone()
        return None if found is None else str(found[0])

    def put(self, key: str, value: str) -> None:
        """Keep a fact of the sweep."""
        self._file.execute("INSERT OR REPLACE INTO sweep VALUES (?, ?)", (key, value))

    def plan(self, cells: Iterable[Cell]) -> list[str]:
        """Make the rows those of a plan, waiting where they are new; return the names of runs that are gone from it."""
        wanted = {cell.key: cell for cell in cells}
        before = set(self._file.execute("SELECT label, scene, seed, rate FROM runs"))
        gone = sorted(before - set(wanted))
        with self._file:
            self._file.execute("BEGIN")
            self._file.executemany(f"DELETE FROM runs WHERE {ONE_RUN}", gone)
            for cell in wanted.values():
                facts = {
                    "method": cell.resolved.method, "preset": cell.resolved.preset,
                    "directory": os.path.relpath(cell.directory, self._out),
                    "config_hash": cell.resolved.config_hash(),
                }  # fmt: skip
                if cell.key not in before:
                    self._file.execute(
                        "INSERT INTO runs (label, scene, seed, rate, method, preset, directory, config_hash, status, "
                        "changed) VALUES (?, ?, ?, ?, ?, ?, ?, ?, 'waiting', ?)", (*cell.key, *facts.values(), _now())
                    )  # fmt: skip
                else:
                    self.note(cell, **facts)
        return [f"{label} {scene} seed {seed} {rate}" for label, scene, seed, rate in gone]

    def note(self, cell: Cell, **facts: object) -> None:
        """Change facts of a run."""
        facts["changed"] = _now()
        columns = ", ".join(f"{name} = ?" for name in facts)
        self._file.execute(f"UPDATE runs SET {columns} WHERE {ONE_RUN}", (*facts.values(), *cell.key))

    def spent(self, cell: Cell, seconds: float) -> None:
        """Add the seconds of a process to a run."""
        self._file.execute(f"UPDATE runs SET seconds = seconds + ? WHERE {ONE_RUN}", (seconds, *cell.key))

    def row(self, cell: Cell) -> Row:
        """Return the state of a run."""
        found = self._file.execute(f"SELECT status, reason FROM runs WHERE {ONE_RUN}", cell.key).fetchone()
        return Row(*found)

    def job_ended(self, name: str, about: tuple[str, str], runs: int, status: str, seconds: float, place: str) -> None:
        """Keep the time of a process, for estimates."""
        self._file.execute("INSERT INTO jobs VALUES (?, ?, ?, ?, ?, ?, ?, ?)",
                           (name, *about, runs, status, seconds, place, _now()))  # fmt: skip

    def durations(self) -> list[tuple[str, str, float]]:
        """Return (label, scene, seconds) of every process that ended well."""
        found = self._file.execute("SELECT label, scene, seconds FROM jobs WHERE status = 'finished'")
        return [(str(label), str(scene), float(seconds)) for label, scene, seconds in found]


def _now() -> str:
    return datetime.now(timezone.utc).isoformat(timespec="seconds")
