"""The form in which a file holds Gaussians that share colours and shapes: 8-bit symbols, indices and half positions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

BITS = 8
HALF_MAX = 65504.0
QUANTIZED = ("opacity", "factor", "dc", "rest", "shape", "quat")
"""Quantized tensors, each with one lattice: opacities, log factors; SH band 0 and the others; shapes, quaternions."""
PER_GAUSSIAN = ("opacity", "factor")
PER_COLOR = ("dc", "rest")


@dataclass(frozen=True)
class CodedGaussians:
    """N Gaussians, Kc colours of K SH coefficients, Kg shapes; a value is step * (symbol - zero).

    means           [N,3] float16
    symbols         name of QUANTIZED -> uint8: opacity [N], factor [N], dc [Kc,1,3], rest [Kc,K-1,3], shape [Kg,3],
                    quat [Kg,4]
    steps, zeros    float32 and int32, of QUANTIZED in order
    color_index     [N] int64, below Kc
    shape_index     [N] int64, below Kg
    """

    means: NDArray[np.float16]
    symbols: Mapping[str, NDArray[np.uint8]]
    steps: NDArray[np.float32]
    zeros: NDArray[np.int32]
    color_index: NDArray[np.int64]
    shape_index: NDArray[np.int64]

    def values(self, name: str) -> NDArray[np.float32]:
        """Values of the symbols of a name: one float32 product, the same on every machine."""
        at = QUANTIZED.index(name)
        whole = self.symbols[name].astype(np.int32) - self.zeros[at]
        found: NDArray[np.float32] = whole.astype(np.float32) * self.steps[at]
        return found

    def in_order(self, order: NDArray[np.int64]) -> CodedGaussians:
        """The Gaussians in this order [N], and only entries that one of them uses, numbered by their first use."""
        colors, color_index = _by_first_use(self.color_index[order])
        shapes, shape_index = _by_first_use(self.shape_index[order])
        rows = {**dict.fromkeys(PER_GAUSSIAN, order), **dict.fromkeys(PER_COLOR, colors)}
        symbols = {name: array[rows.get(name, shapes)] for name, array in self.symbols.items()}
        return CodedGaussians(self.means[order], symbols, self.steps, self.zeros, color_index, shape_index)


def _by_first_use(index: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Old numbers of the entries in their new order, and the index by new numbers."""
    used, first, inverse = np.unique(index, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return used[order], rank[inverse.reshape(-1)]
