"""Higher SH coefficients of all three channels in one basis of the scene's own: the eigenvectors of their covariance.

Coefficients of trained Gaussians depend on each other across bands and channels; along the eigenvectors they do not,
and most are small. The basis is stored in 8 bits, so sums are exact; the encoder inverts the matrix that is stored.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatwizard_core.api import BitstreamError
from sw_codecs.models.luma import COLOR

UNIT = 127
"""Stored for a 1."""
ENOUGH = 1 << 18
"""Rows that a basis is fitted to, evenly taken from more: some thousand covariances are well known from these."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Basis:
    """Eigenvectors, and what they are worth.

    matrix      [K,K] in rows, in the order of falling variance
    variances   [2,K] of what is coded without and with it, in units of the squared factors of rows
    """

    matrix: NDArray[np.int8]
    variances: Array

    def to(self, rest: NDArray[Any]) -> Array:
        """Coordinates [N,K] of coefficients [N,K]."""
        found: Array = rest @ self._inverse
        return found

    @cached_property
    def _inverse(self) -> Array:
        return np.linalg.inv(self.matrix.astype(np.float64) / UNIT)

    def pays(self, count: int, step: float) -> bool:
        """Whether it saves more than it takes for so many rows: bits of normal numbers, about."""
        without, within = 0.5 * np.log2(1 + 12 * self.variances / step**2).sum(axis=1)
        return bool(count * (without - within) > 8 * self.matrix.size)


def stride(rows: int) -> int:
    """Of so many rows every n-th is fitted to."""
    return max(1, rows // ENOUGH)


def fit(parts: Sequence[NDArray[Any]], factors: Array) -> Basis:
    """Return the basis of some coefficients.

    parts       [n,K] red, green and blue of each coefficient, some rows each
    factors     [N] of the steps of all rows
    """
    width = parts[0].shape[1]
    covariance, end = np.zeros((width, width)), 0
    for part in parts:
        start, end = end, end + len(part)
        scaled = part / factors[start:end, None]
        covariance += scaled.T @ scaled
    return of_covariance(covariance / max(end, 1))


def of_covariance(covariance: Array) -> Basis:
    """Return the basis of coefficients with this covariance [K,K], of what they are in the steps of their rows."""
    width = len(covariance)
    vectors = np.linalg.eigh(covariance)[1][:, ::-1].T
    largest = np.take_along_axis(vectors, np.abs(vectors).argmax(axis=1)[:, None], axis=1)
    matrix = np.rint(UNIT * vectors * np.sign(largest)).astype(np.int8)
    plain = np.kron(np.eye(width // 3), COLOR.T)
    variances = [np.diag(to.T @ covariance @ to) for to in (plain, np.linalg.inv(matrix / UNIT))]
    return Basis(matrix, np.maximum(variances, 0))


def from_basis(symbols: NDArray[np.int32], basis: NDArray[np.int8]) -> Array:
    """Coefficients [N,K] in 1/127 of a step. All sums are integers below 2^53, so their order does not matter."""
    found: Array = symbols.astype(np.float64) @ basis.astype(np.float64)
    return found


def unpack(data: bytes, width: int) -> NDArray[np.int8]:
    """Basis [width,width] of a section, row after row. Raises BitstreamError."""
    if len(data) != width * width:
        raise BitstreamError(f"{len(data):,} bytes, a basis of {width} coefficients has {width * width:,}")
    return np.frombuffer(data, np.int8).reshape(width, width)
