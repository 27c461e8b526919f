"""The shipped integers of the exact mode: step multipliers, scale levels and thresholds, and count tables.

Read from data/exact_tables.bin, which tools/make_exact_tables.py wrote with 40-digit arithmetic: the decoder computes
no exp, erfc or tanh, whose last bits differ between machines. Version and CRC-32 of the file go into every bitstream.
"""

from __future__ import annotations

import functools
import importlib.resources
import struct
import zlib
from dataclasses import dataclass

import numpy as np

from splatwizard_core.api import BitstreamError

LEVELS, FRACTIONS, STEPS = 64, 8, 128
_PREFIX = struct.Struct("<4sHI")


@dataclass(frozen=True)
class Family:
    """The 512 tables of one density; table number = level * 8 + fraction.

    radius  [64]  int64: table entries are s = -radius..radius and then the escape
    counts        float64 [entries] of whole numbers, per table number
    """

    radius: np.ndarray
    counts: tuple[np.ndarray, ...]


@dataclass(frozen=True)
class ExactTables:
    """multipliers [128] m_j (step = base step * m_j / 4096); scales [64] and thresholds [63], the latter in 1/4096."""

    version: int
    crc: int
    multipliers: np.ndarray
    scales: np.ndarray
    thresholds: np.ndarray
    gaussian: Family
    laplace: Family

    def check(self, version: int, crc: int) -> None:
        """Raise BitstreamError unless a file that names these was coded with the tables at hand."""
        if (version, crc) != (self.version, self.crc):
            raise BitstreamError(
                f"coded with exact tables {version} ({crc:08x}), installed are {self.version} ({self.crc:08x}): "
                "install the sw-codecs version that wrote the file"
            )


def parse(data: bytes) -> ExactTables:
    """The tables in a data file. Raises BitstreamError if it is damaged."""
    if len(data) < _PREFIX.size + 4 or zlib.crc32(data[:-4]) != int.from_bytes(data[-4:], "little"):
        raise BitstreamError("the exact tables of sw-codecs are damaged: reinstall the package")
    magic, version, length = _PREFIX.unpack_from(data)
    if magic != b"SPWT" or version != 1 or len(data) != _PREFIX.size + length + 4:
        raise BitstreamError(f"exact tables of version {version} are not known: reinstall sw-codecs")
    position = _PREFIX.size

    def take(count: int, dtype: str) -> np.ndarray:
        nonlocal position
        array = np.frombuffer(data, dtype, count, position).astype(np.int64)
        position += array.size * np.dtype(dtype).itemsize
        return array

    multipliers, scales, thresholds = take(STEPS, "<u2"), take(LEVELS, "<u4") / 2.0**20, take(LEVELS - 1, "<u4")
    families = []
    for _ in range(2):
        radius = take(LEVELS, "<u2")
        sizes = np.repeat(2 * radius + 2, FRACTIONS)
        counts = (take(int(sizes.sum()), "<u2") + 1).astype(np.float64)
        families.append(Family(radius, tuple(np.split(counts, np.cumsum(sizes)[:-1]))))
    return ExactTables(version, int.from_bytes(data[-4:], "little"), multipliers, scales, thresholds, *families)


@functools.cache
def exact_tables() -> ExactTables:
    """The tables of this installation, read once."""
    return parse(importlib.resources.files("sw_codecs").joinpath("data/exact_tables.bin").read_bytes())


def step_multipliers(outputs: np.ndarray) -> np.ndarray:
    """Step multipliers 64..8192 (int64) for network outputs t with 12 fractional bits: round(4096 (1 + tanh t)).

    Raises ValueError for floats: they would be cut off, and are not exact.
    """
    if not np.issubdtype(np.asarray(outputs).dtype, np.integer):
        raise ValueError(f"step outputs must be integers, not {np.asarray(outputs).dtype}")
    j = np.clip((np.asarray(outputs, np.int64) + (1 << 15)) >> 9, 0, 127)
    return exact_tables().multipliers[j]
