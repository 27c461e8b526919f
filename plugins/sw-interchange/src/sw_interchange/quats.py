"""Smallest-three codes of unit quaternions: the largest component is left out and follows from the others.

Formats differ in the order of components, in how the three are coded, and in who holds the index.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from sw_interchange.bands import Array

Indices = npt.NDArray[np.intp]

OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
"""Index of the largest -> the others, ascending."""
ROOT_2 = np.float32(np.sqrt(2))


def smallest_three(quats: Array) -> tuple[Indices, Array]:
    """Index [N] of the largest component (the first on ties), and the others [N,3], ascending, with that one positive.

    quats   [N,4] unit, in the order of the format
    """
    rows = np.arange(len(quats))
    largest = np.abs(quats).argmax(1)
    signs = np.where(quats[rows, largest] < 0, np.float32(-1), np.float32(1))
    return largest, quats[rows[:, None], OTHERS[largest]] * signs[:, None]


def from_smallest_three(largest: npt.NDArray[np.integer], others: Array) -> Array:
    """[N,4] of what `smallest_three` gives; what is too long for a unit quaternion gets a largest component of 0."""
    quats = np.empty((len(others), 4), np.float32)
    rest = np.sqrt(np.maximum(0, 1 - np.einsum("ij,ij->i", others, others)))
    # One pass for each component: quicker than scattering by index.
    for i in range(4):
        column = np.where(largest == i, rest, 0)
        for k in range(3):
            column += np.where(OTHERS[largest, k] == i, others[:, k], 0)
        quats[:, i] = column
    return quats
