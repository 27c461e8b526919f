"""Collecting result records from a folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from splatwizard_core.errors import UserInputError
from splatwizard_core.experiments.record import FILE_NAME, Record, read_record


def collect_records(root: Path) -> list[Record]:
    """Every record under `root` (a run directory, or a tree of them), by scene, method and size.

    Raises UserInputError if there is none, or one cannot be read.
    """
    paths = [root / FILE_NAME] if (root / FILE_NAME).is_file() else sorted(root.rglob(FILE_NAME))
    if not paths:
        raise UserInputError(f"no {FILE_NAME} under {root}: `sw run --out {root}` makes them")
    return sort_records([read_record(path) for path in paths])


def sort_records(records: Sequence[Record]) -> list[Record]:
    """By scene, method, then bytes."""
    return sorted(records, key=lambda r: (r.scene, r.method, r.file.bytes))
