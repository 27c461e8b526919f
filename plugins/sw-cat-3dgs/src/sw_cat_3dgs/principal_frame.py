"""Frame of a cloud: places in a unit cube along its principal axes, with far points pulled in.

The frame of a triplane: world -> principal axes, in standard deviations -> contraction into a ball -> the box of the
inliers. Its constants are floats in the file; places are computed from position codes in integers alone, so that every
machine finds the same. Training uses the very same places. Source: CAT-3DGS (arXiv 2503.00357); the contraction is
that of mip-NeRF 360 (arXiv 2111.12077).
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from sw_cat_3dgs.outliers import inliers

UNIT = 1 << 20
"""Places are integers 0 .. UNIT from one side of the box to the other."""
CODE_BITS = 16
FAR = 1 << 10
"""Standard deviations beyond which points count as this far along an axis; well outside the box by then."""
SAMPLE = 200_000
"""Points that a frame is fitted to at most: mean and covariance of more hardly differ, and neighbours take time."""

_FRACTION = 16  # of coordinates in standard deviations
_EXTRA = range(20, -1, -4)  # further bits of the affine map: as many as fit


@dataclass(frozen=True)
class PrincipalFrame:
    """mean [3], axes [3,3] (columns, longest axis first), std [3], low [3] and high [3] of the box; float32."""

    mean: np.ndarray
    axes: np.ndarray
    std: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def fit(cls, points: np.ndarray, *, neighbors: int = 50, contamination: float = 0.05) -> PrincipalFrame:
        """The frame of a cloud [N,3] without its outliers.

        neighbors, contamination    of the Local Outlier Factor, and the share of points that it leaves out

        Raises ValueError for a cloud without points.
        """
        xyz = np.asarray(points, np.float64)
        if len(xyz) == 0:
            raise ValueError("a frame needs at least one point")
        xyz = xyz[:: -(-len(xyz) // SAMPLE)]
        xyz = xyz[inliers(xyz, neighbors=neighbors, contamination=contamination)]
        mean = xyz.mean(axis=0)
        variances, axes = np.linalg.eigh((xyz - mean).T @ (xyz - mean) / max(len(xyz) - 1, 1))
        variances, axes = variances[::-1].clip(0), axes[:, ::-1]
        # A sign that does not hang on the library: the largest component of each axis is positive.
        axes = axes * np.sign(axes[np.abs(axes).argmax(axis=0), range(3)])
        std = np.sqrt(variances)
        std = np.maximum(std, 1e-6 * std.max()) if std.max() > 0 else np.ones(3)  # a flat cloud must not explode
        place = _place((xyz - mean) @ axes / std)
        constants = (mean, axes, std, place.min(axis=0), place.max(axis=0))
        return cls(*(np.ascontiguousarray(each, np.float32) for each in constants))

    def unit(self, codes: Tensor, low: np.ndarray, step: np.ndarray) -> Tensor:
        """Places of the points low + code * step: int64 [N,3] in 0 .. UNIT; what lies outside the box is on its side.

        codes       int64 [N,3] in 0 .. 65535
        low, step   [3] of the position lattice, world units; float32 or float64, bit for bit those of the decoder

        Raises ValueError if the constants make no sense.
        """
        rows, low_side, width = self._integers(np.asarray(low, np.float64), np.asarray(step, np.float64))
        if codes.numel() and (int(codes.min()) < 0 or int(codes.max()) >> CODE_BITS):
            raise ValueError(f"position codes must have {CODE_BITS} bits")
        one = 1 << _FRACTION
        columns = []
        for a, b, c, constant, extra in rows:
            total = codes[:, 0] * a + codes[:, 1] * b + codes[:, 2] * c + constant
            columns.append((total >> extra).clamp(-FAR * one, FAR * one))
        y = torch.stack(columns, dim=1)  # [N,3] standard deviations, 16 fractional bits
        norm = _integer_sqrt((y * y).sum(dim=1, keepdim=True))
        outside = norm > one
        norm = torch.where(outside, norm, one)
        factor = torch.div((2 * norm - one) << _FRACTION, norm, rounding_mode="floor")  # 2 - 1/|y|
        pulled = torch.where(outside, torch.div(factor * y, norm, rounding_mode="floor"), y)
        place = pulled + 2 * one  # place / 4 + 1/2 with 18 fractional bits
        sides = [torch.tensor(side, device=codes.device) for side in (low_side, width)]
        return torch.div((place - sides[0]) << 20, sides[1], rounding_mode="floor").clamp(0, UNIT)

    def _integers(self, origin: np.ndarray, step: np.ndarray) -> tuple[list[list[int]], list[int], list[int]]:
        """For each axis [x, y, z, constant, extra], the map from codes to standard deviations with 16 + extra
        fractional bits; low side and width of the box with 18. Single IEEE operations in a fixed order: the same on
        every machine."""
        mean, axes, std, low, high = (getattr(self, f.name).astype(np.float64) for f in fields(self))
        with np.errstate(all="ignore"):  # a hostile file may overflow; looked at below
            away = origin - mean
            slope = axes.T * step[None] / std[:, None]
            shift = (axes[0] * away[0] + axes[1] * away[1] + axes[2] * away[2]) / std
            largest = (np.abs(slope).sum(axis=1) * 2.0**CODE_BITS + np.abs(shift)) * 2.0**_FRACTION
            box = np.rint(np.stack([low, high]) * 2.0**18)
        if not ((largest < 2.0**61).all() and (np.abs(box) < 2.0**30).all()):  # also false for NaN
            raise ValueError("the frame of the triplane is not usable: its constants are damaged or hostile")
        rows = []
        for row, constant, size in zip(slope, shift, largest, strict=True):
            extra = next(bits for bits in _EXTRA if size * 2.0**bits < 2.0**61 or bits == 0)
            rows.append([*(int(v) for v in np.rint(np.append(row, constant) * 2.0 ** (_FRACTION + extra))), extra])
        return rows, *(each.astype(np.int64).tolist() for each in (box[0], np.maximum(box[1] - box[0], 1)))

    def rows(self) -> np.ndarray:
        """float32 [7,3], what the file has: mean, the rows of the axes, std, low, high."""
        return np.concatenate([np.atleast_2d(getattr(self, f.name)) for f in fields(self)])

    @classmethod
    def from_rows(cls, rows: np.ndarray) -> PrincipalFrame:
        """Inverse of `rows`."""
        return cls(rows[0], rows[1:4], *rows[4:])


def _place(y: np.ndarray) -> np.ndarray:
    """Standard deviations [N,3] along the axes to the cube 0 .. 1."""
    return contract(y.clip(-FAR, FAR)) / 4 + 0.5


def contract(y: np.ndarray) -> np.ndarray:
    """y [N,3] itself where |y| <= 1, else (2 - 1/|y|) y/|y|: all of space in a ball of radius 2."""
    norm = np.maximum(np.linalg.norm(y, axis=1, keepdims=True), 1e-300)
    return np.where(norm <= 1, y, (2 - 1 / norm) * (y / norm))


def _integer_sqrt(values: Tensor) -> Tensor:
    """floor(sqrt(v)) of int64 v < 2^56, exactly."""
    root = values.to(torch.float64).sqrt().to(torch.int64)  # at most one off
    root = root - (root * root > values).to(torch.int64)
    return root + ((root + 1) * (root + 1) <= values).to(torch.int64)
