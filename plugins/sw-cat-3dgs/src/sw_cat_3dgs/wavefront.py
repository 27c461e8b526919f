"""Coding integer planes: each value after the twelve neighbours that its distribution hangs on.

Files are written as independent streams (`plane_streams`); those of version 1, one stream for all planes, are read.
Everything is in integers: the symbols depend neither on how rows are batched nor on the number of threads. Source:
CAT-3DGS (arXiv 2503.00357) for the order, the exact mode of the codec library (rules 3 to 6) for the tables.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from splatwizard_core.api import BitstreamError
from sw_cat_3dgs import plane_streams
from sw_cat_3dgs.plane_fields import Field, PlaneModel, lattice_of, predicted
from sw_codecs.entropy.exact_streams import table_bits as bits_of
from sw_codecs.entropy.exact_version_1 import ExactReader

SYMBOL_LIMIT = 1 << 24


def encode(planes: Sequence[np.ndarray], models: Sequence[PlaneModel]) -> bytes:
    """Bytes of integer planes [K, C, H, W] per scale, K = len(models); decoded again and compared.

    Raises ValueError for values of 2^24 or more.
    """
    _shapes(planes, models)
    return plane_streams.encode(planes, models)


def decode(data: bytes, shapes: Sequence[tuple[int, int, int]], models: Sequence[PlaneModel]) -> list[np.ndarray]:
    """Inverse of `encode`: int32 or int64 [K, C, H, W] for each (C, H, W).

    Memory and time grow with the shapes, which the caller bounds. Raises BitstreamError for damage or other models.
    """
    if data[:2] != b"\x01\x00":
        return plane_streams.decode(data, shapes, models)
    fields = [Field(len(models), shape) for shape in shapes]
    reader = ExactReader("laplace", data)
    for step in _steps(fields):
        due = [(field, at) for field in fields if len(at := field.step(step))]
        found = [lattice_of(models, [field.neighbors(k, at) for k in range(len(models))]) for field, at in due]
        symbols = reader.get(*(np.concatenate([each[i] for each in found]) for i in (0, 1)))
        if np.abs(symbols).max(initial=0) >= SYMBOL_LIMIT:
            raise BitstreamError("a value of a plane is beyond 2^24: damaged data or other models")
        start = 0
        for field, at in due:
            count = field.rows * len(at)
            field.put(at, symbols[start : start + count])
            start += count
    reader.finish()
    return [field.planes() for field in fields]


def table_bits(planes: Sequence[np.ndarray], models: Sequence[PlaneModel]) -> float:
    """Bits that `encode` spends on the values."""
    total = 0.0
    for plane, shape in zip(planes, _shapes(planes, models), strict=True):
        field = Field(len(models), shape)
        field.fill(plane)
        centre, number = predicted(field, models)
        total += float(bits_of("laplace", plane.reshape(-1), centre.reshape(-1), number.reshape(-1)).sum())
    return total


def _steps(fields: Sequence[Field]) -> list[int]:
    """The steps in which some plane has values: narrow planes leave gaps."""
    return [s for s in range(max((f.steps for f in fields), default=0)) if any(len(f.step(s)) for f in fields)]


def _shapes(planes: Sequence[np.ndarray], models: Sequence[PlaneModel]) -> list[tuple[int, int, int]]:
    shapes = []
    for plane in planes:
        if plane.ndim != 4 or len(plane) != len(models) or not np.issubdtype(plane.dtype, np.integer):
            raise ValueError(f"planes must be integers [{len(models)}, C, H, W], not {plane.dtype} {plane.shape}")
        if plane.size and np.abs(plane).max() >= SYMBOL_LIMIT:
            raise ValueError("a value of a plane is beyond 2^24")
        shapes.append((plane.shape[1], plane.shape[2], plane.shape[3]))
    return shapes
