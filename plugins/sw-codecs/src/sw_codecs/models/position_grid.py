"""A grid for positions that neither far floaters nor an empty margin can spoil.

Per axis, u = (x - center) / width is mapped to v(u), linear for |u| <= 1 and then one unit of v per octave
(piecewise linear, as the mantissa and exponent of a float), and v is cut into 2^bits equal cells over -top .. top.
A Gaussian at 100 widths costs three more bits for everybody instead of seven, and its cell is larger in
proportion to its distance, which is how large an error looks to a camera near the centre. The inverse uses only
exact operations (multiplication, addition, powers of two), so positions decode alike on every machine.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

MAX_TOP = 40
CORE_SHARE = 0.75
"""Share of the Gaussians, per axis, that lies in the linear part."""
ROWS_AT_ONCE = 1 << 14
"""Points whose cells are found together: doubles of all would outweigh their cells several times."""


@dataclass(frozen=True)
class PositionGrid:
    """center [3], width [3] > 0 world units, top [3] int >= 1, bits per axis."""

    center: tuple[float, float, float]
    width: tuple[float, float, float]
    top: tuple[int, int, int]
    bits: int

    @classmethod
    def fit(cls, points: NDArray[Any], bits: int) -> PositionGrid:
        """The grid for these points [N,3], finite."""
        if len(points) == 0:
            return cls((0.0,) * 3, (1.0,) * 3, (1,) * 3, bits)
        facts = []
        for axis in range(3):  # doubles of one at a time
            along = np.array(points[:, axis], dtype=np.float64)
            center = np.median(along)
            along -= center
            away = np.abs(along, out=along)
            facts.append((center, np.quantile(away, CORE_SHARE), away.max()))
        return cls.around(*np.array(facts).T, bits)

    @classmethod
    def around(
        cls, center: NDArray[np.float64], core: NDArray[np.float64], reach: NDArray[np.float64], bits: int
    ) -> PositionGrid:
        """The grid for points whose median, distances that hold CORE_SHARE, and largest distances [3] are known."""
        # A flat axis has no width of its own; a millionth of its reach keeps the octaves few.
        width = np.maximum(core, np.maximum(reach * 1e-6, 1e-9))
        # floor + 1 rather than ceil: the outermost point stays inside the last cell.
        top = np.floor(_compress(reach / width)).astype(int) + 1
        return cls(_triple(center), _triple(width), (int(top[0]), int(top[1]), int(top[2])), bits)

    def quantize(self, points: NDArray[Any]) -> NDArray[np.int64]:
        """Cells [N,3] int64 in 0 .. 2^bits - 1 of points [N,3]."""
        top = np.asarray(self.top, dtype=np.float64)
        found = np.empty((len(points), 3), np.int64)
        for start in range(0, len(points), ROWS_AT_ONCE):
            part = slice(start, start + ROWS_AT_ONCE)
            u = (np.asarray(points[part], dtype=np.float64) - self.center) / self.width
            v = np.copysign(_compress(np.abs(u)), u)
            cells = np.floor((v + top) / (2 * top) * 2.0**self.bits).astype(np.int64)
            np.clip(cells, 0, 2**self.bits - 1, out=found[part])
        return found

    def dequantize(self, cells: NDArray[Any]) -> NDArray[np.float32]:
        """Cell centres [N,3] float32."""
        top = np.asarray(self.top, dtype=np.float64)
        v = (cells.astype(np.float64) + 0.5) * (2 * top * 2.0**-self.bits) - top
        u = np.copysign(_expand(np.abs(v)), v)
        return (u * self.width + self.center).astype(np.float32)


def _compress(a: NDArray[np.float64]) -> NDArray[np.float64]:
    """v of |u| >= 0."""
    mantissa, exponent = np.frexp(np.maximum(a, 1.0))  # a = mantissa 2^exponent, mantissa in [0.5, 1)
    return np.where(a < 1.0, a, exponent + 2 * mantissa - 1.0)


def _expand(v: NDArray[np.float64]) -> NDArray[np.float64]:
    """|u| of v >= 0."""
    octave = np.floor(np.maximum(v, 1.0))
    return np.where(v < 1.0, v, np.ldexp(1.0 + (v - octave), octave.astype(np.int32) - 1))


def _triple(values: NDArray[np.float64]) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])
