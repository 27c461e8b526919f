"""Coding integer planes along wavefronts: each value after the twelve neighbours that its distribution hangs on.

A step codes all values with the same column + 3 row, of all channels, orientations and scales together: the neighbours
of each lie in earlier steps. So a decoder evaluates a network on thousands of rows at once, W + 3 (H - 1) times, and
everything is in integers: the symbols do not depend on how rows are batched. Source: CAT-3DGS (arXiv 2503.00357) for
the order, the exact mode of the codec library (rules 3 to 6) for the tables.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from splatwizard_core.api import BitstreamError
from sw_codecs.entropy.exact_stream import ExactReader, ExactWriter, exact_bits
from sw_codecs.entropy.exact_tables import FRACTIONS

NEIGHBORS = (*((-2, right) for right in range(-2, 3)), *((-1, right) for right in range(-2, 3)), (0, -2), (0, -1))
"""(rows down, columns right) of the neighbours, in raster order."""
SYMBOL_LIMIT = 1 << 24


class PlaneModel(Protocol):
    """Predictor of a plane, such as `ExactSpatialAr`."""

    def __call__(self, neighbors: Tensor) -> tuple[np.ndarray, np.ndarray]:
        """(mean int64 [n] with 12 fractional bits, level 0..63) for neighbours int64 [n, 12]."""
        ...


def encode(planes: Sequence[np.ndarray], models: Sequence[PlaneModel]) -> bytes:
    """Bytes of integer planes [K, C, H, W] per scale, K = len(models); decoded again and compared.

    Raises ValueError for values of 2^24 or more.
    """
    shapes = _shapes(planes, models)
    fields = [_Field(len(models), shape) for shape in shapes]
    for field, plane in zip(fields, planes, strict=True):
        field.fill(plane)
    predicted = [_predicted(field, models) for field in fields]
    writer = ExactWriter("laplace")
    for step in _steps(fields):
        parts = [
            (field.values(at), c[..., at].reshape(-1), t[..., at].reshape(-1))
            for field, (c, t) in zip(fields, predicted, strict=True)
            if len(at := field.step(step))
        ]
        writer.put(*(np.concatenate(each) for each in zip(*parts, strict=True)))
    data = writer.finish()
    if any((a != b).any() for a, b in zip(decode(data, shapes, models), planes, strict=True)):
        raise RuntimeError("planes do not decode to what was encoded; please report this")
    return data


def decode(data: bytes, shapes: Sequence[tuple[int, int, int]], models: Sequence[PlaneModel]) -> list[np.ndarray]:
    """Inverse of `encode`: int64 [K, C, H, W] for each (C, H, W).

    Memory and time grow with the shapes, which the caller bounds. Raises BitstreamError for damage or other models.
    """
    fields = [_Field(len(models), shape) for shape in shapes]
    reader = ExactReader("laplace", data)
    for step in _steps(fields):
        due = [(field, at) for field in fields if len(at := field.step(step))]
        found = [_lattice(models, [field.neighbors(k, at) for k in range(len(models))]) for field, at in due]
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
        field = _Field(len(models), shape)
        field.fill(plane)
        centre, number = _predicted(field, models)
        total += float(exact_bits("laplace", plane.reshape(-1), centre.reshape(-1), number.reshape(-1)).sum())
    return total


def _steps(fields: Sequence[_Field]) -> list[int]:
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


def _predicted(field: _Field, models: Sequence[PlaneModel]) -> tuple[np.ndarray, np.ndarray]:
    """Integer part of the means and table numbers of all values of filled planes, each [K, C, H W]."""
    everything = np.arange(field.height * field.width)
    centre, number = _lattice(models, [field.neighbors(k, everything) for k in range(len(models))])
    shape = (len(models), field.channels, len(everything))
    return centre.reshape(shape), number.reshape(shape)


def _lattice(models: Sequence[PlaneModel], neighbors: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Integer part of each mean (int64), and its table number (uint16)."""
    means, levels = zip(*(model(torch.from_numpy(n)) for model, n in zip(models, neighbors, strict=True)), strict=True)
    eighths = (8 * np.concatenate(means) + 2048) >> 12
    centre = (eighths + 4) >> 3
    return centre, (np.concatenate(levels) * FRACTIONS + eighths + 4 - 8 * centre).astype(np.uint16)


@dataclass
class _Field:
    """The planes [K, C, H, W] of one scale within a border of zeros, addressed by position r W + c in a plane."""

    orientations: int
    shape: tuple[int, int, int]

    def __post_init__(self) -> None:
        self.channels, self.height, self.width = self.shape
        self.rows = self.orientations * self.channels
        self._stride = self.width + 4
        self._padded = np.zeros((self.orientations, self.channels, (self.height + 2) * self._stride), np.int64)
        self._around = np.array([down * self._stride + right for down, right in NEIGHBORS])

    @property
    def steps(self) -> int:
        return self.width + 3 * (self.height - 1) if min(self.shape) > 0 else 0

    def step(self, index: int) -> np.ndarray:
        """Positions with column + 3 row = index, by row."""
        if index >= self.steps:
            return np.empty(0, np.int64)
        row = np.arange(max(0, -((self.width - 1 - index) // 3)), min(self.height - 1, index // 3) + 1)
        return row * self.width + index - 3 * row

    def _inner(self, at: np.ndarray) -> np.ndarray:
        return (at // self.width + 2) * self._stride + at % self.width + 2

    def neighbors(self, orientation: int, at: np.ndarray) -> np.ndarray:
        """int64 [C len(at), 12], channel by channel."""
        index = self._inner(at)[:, None] + self._around
        return self._padded[orientation].take(index, axis=1).reshape(-1, len(NEIGHBORS))

    def values(self, at: np.ndarray) -> np.ndarray:
        """By orientation, then channel, then position."""
        return self._padded[:, :, self._inner(at)].reshape(-1)

    def put(self, at: np.ndarray, values: np.ndarray) -> None:
        """Inverse of `values`."""
        self._padded[:, :, self._inner(at)] = values.reshape(self.orientations, self.channels, len(at))

    def fill(self, planes: np.ndarray) -> None:
        self.put(np.arange(self.height * self.width), planes.reshape(-1))

    def planes(self) -> np.ndarray:
        everything = np.arange(self.height * self.width)
        return self.values(everything).reshape(self.orientations, *self.shape)
