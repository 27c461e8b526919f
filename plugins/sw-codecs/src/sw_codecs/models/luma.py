"""Colours as luma and two chroma.

Higher SH coefficients of the three channels are strongly correlated in trained scenes. The transform is orthonormal, so
that one step size means one squared error in all three.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

COLOR = np.array(
    [
        [1 / math.sqrt(3), 1 / math.sqrt(3), 1 / math.sqrt(3)],
        [1 / math.sqrt(2), 0.0, -1 / math.sqrt(2)],
        [1 / math.sqrt(6), -2 / math.sqrt(6), 1 / math.sqrt(6)],
    ]
)
"""Rows luma, red-blue, green-magenta of red, green, blue."""


def to_luma(rgb: NDArray[Any]) -> NDArray[np.float64]:
    """[..., 3] red, green, blue -> luma, red-blue, green-magenta."""
    r, g, b = np.moveaxis(np.asarray(rgb, np.float64), -1, 0)
    found = np.empty(rgb.shape)
    for i, row in enumerate(COLOR):
        found[..., i] = row[0] * r + row[1] * g + row[2] * b
    return found


def to_rgb(luma: NDArray[np.float64]) -> NDArray[np.float64]:
    """Inverse of `to_luma`: the transposed matrix."""
    y, u, v = np.moveaxis(luma, -1, 0)
    found = np.empty(luma.shape)
    for i, column in enumerate(COLOR.T):
        found[..., i] = column[0] * y + column[1] * u + column[2] * v
    return found
