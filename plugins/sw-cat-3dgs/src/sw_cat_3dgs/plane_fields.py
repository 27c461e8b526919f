"""Integer planes with the neighbours that the distribution of each value hangs on, addressed along wavefronts.

All values with the same column + 3 row, of all channels, orientations and scales, hang on earlier ones alone. Source:
CAT-3DGS (arXiv 2503.00357).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from sw_cat_3dgs.spatial_ar import NEIGHBORS
from sw_codecs.entropy.exact_tables import FRACTIONS

Shape = tuple[int, int, int]
"""Channels, rows and columns of a plane."""


class PlaneModel(Protocol):
    """Predictor of a plane, such as `ExactSpatialAr`."""

    def __call__(self, neighbors: Tensor) -> tuple[np.ndarray, np.ndarray]:
        """(mean int64 [n] with 12 fractional bits, level 0..63) for neighbours int64 [n, 12]."""
        ...


@dataclass
class Field:
    """The planes [K, C, H, W] of one scale within a border of zeros, addressed by position r W + c in a plane."""

    orientations: int
    shape: Shape

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

    def put_some(self, orientation: int, channels: slice, at: np.ndarray, values: np.ndarray) -> None:
        """Put values [channels, len(at)] of some channels of a plane."""
        self._padded[orientation][channels, self._inner(at)] = values

    def fill(self, planes: np.ndarray) -> None:
        self.put(np.arange(self.height * self.width), planes.reshape(-1))

    def planes(self) -> np.ndarray:
        everything = np.arange(self.height * self.width)
        return self.values(everything).reshape(self.orientations, *self.shape)


def predicted(field: Field, models: Sequence[PlaneModel]) -> tuple[np.ndarray, np.ndarray]:
    """Integer part of the means and table numbers of all values of filled planes, each [K, C, H W]."""
    everything = np.arange(field.height * field.width)
    centre, number = lattice_of(models, [field.neighbors(k, everything) for k in range(len(models))])
    shape = (len(models), field.channels, len(everything))
    return centre.reshape(shape), number.reshape(shape)


def lattice_of(models: Sequence[PlaneModel], neighbors: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Integer part of each mean (int64), and its table number (uint16)."""
    means, levels = zip(*(model(torch.from_numpy(n)) for model, n in zip(models, neighbors, strict=True)), strict=True)
    eighths = (8 * np.concatenate(means) + 2048) >> 12
    centre = (eighths + 4) >> 3
    return centre, (np.concatenate(levels) * FRACTIONS + eighths + 4 - 8 * centre).astype(np.uint16)
