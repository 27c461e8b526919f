"""A .ply of Gaussians some rows at a time: of a large file never all is in memory."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from sw_gaussians.ply import from_ply
from sw_gaussians.ply_tables import MAX_HEADER, read_header

from splatwizard_core.api import GaussianModel, SplatwizardError

ROWS_AT_ONCE = 1 << 15
"""Rows of a block: 8 MB at SH degree 3."""


@dataclass(frozen=True)
class PlyBlocks:
    """Rows of a binary file; each pass over it reads them again.

    count       rows, also of those that mean nothing
    head        the header, with a place for the number of rows
    rows_at     where the first row begins, bytes
    row_bytes   of one row
    """

    path: Path
    count: int
    head: bytes
    rows_at: int
    row_bytes: int

    def __iter__(self) -> Iterator[GaussianModel]:
        """Yield models, rows in file order; rows that mean nothing are left out, as `load_ply` does.

        Raises BitstreamError, SceneError.
        """
        with self.path.open("rb") as file:
            file.seek(self.rows_at)
            for start in range(0, self.count, ROWS_AT_ONCE):
                rows = min(ROWS_AT_ONCE, self.count - start)
                data = self.head.replace(_ROWS, b"%d" % rows) + file.read(rows * self.row_bytes)
                try:
                    yield from_ply(data, str(self.path), tell=start == 0)
                except SplatwizardError as error:
                    if type(error) is not SplatwizardError:  # of its own kind: all rows of the block mean nothing
                        raise


def blocks_of(path: Path) -> PlyBlocks | None:
    """The rows of a .ply; None where they cannot be read by themselves: text, or elements before the Gaussians.

    Raises BitstreamError for a damaged header.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(MAX_HEADER)
    header = read_header(head, size, path.name)
    first = header.elements[0] if header.elements else None
    # Coordinates in doubles are moved by the median of all rows.
    if not header.order or first is None or first.name != "vertex" or ("x", "f8") in first.fields:
        return None
    row_bytes = sum(int(code[1]) for _, code in first.fields)
    counted = re.sub(rb"(?<=[\r\n])element[ \t]+(\S+)[ \t]+\d+", _without_count, head[: header.rows_at])
    return PlyBlocks(path, first.count, counted, header.rows_at, row_bytes)


_ROWS = b"{rows}"


def _without_count(line: re.Match[bytes]) -> bytes:
    return b"element vertex " + _ROWS if line[1] == b"vertex" else b"element %s 0" % line[1]
