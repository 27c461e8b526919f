"""Gaussians on the leaves of an octree: the grid of their positions, and one Gaussian a voxel."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Anchor = Literal["center", "corner"]
MergeRule = Literal["mean", "importance", "random"]

QUATS = "quats"
"""Rows of this name are rotations: their mean is that of unit quaternions on one half of the sphere."""


@dataclass(frozen=True)
class VoxelGrid:
    """2^depth equal cells on each axis of a box.

    low, high   corners of the box, world units, high >= low
    depth       1..21, levels of the octree
    anchor      where in its cell a Gaussian lies: "center", or "corner" (the lower one, as in the code of MesonGS)
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    depth: int
    anchor: Anchor = "center"

    @classmethod
    def fit(cls, points: NDArray[Any], depth: int, anchor: Anchor = "center") -> VoxelGrid:
        """Return the grid over the bounding box of finite points [N,3]; of no points a box of no size."""
        if not len(points):
            return cls((0.0,) * 3, (0.0,) * 3, depth, anchor)
        low, high = points.min(0).astype(np.float64).tolist(), points.max(0).astype(np.float64).tolist()
        return cls((low[0], low[1], low[2]), (high[0], high[1], high[2]), depth, anchor)

    def cells(self, points: NDArray[Any]) -> NDArray[np.int64]:
        """Return the cells [N,3], 0 .. 2^depth - 1, of points [N,3]; the far border belongs to the last cell."""
        low, width = np.array(self.low), np.array(self.high) - self.low
        share = (points.astype(np.float64) - low) / np.where(width > 0, width, 1.0)
        return np.clip(np.floor(share * 2.0**self.depth), 0, 2**self.depth - 1).astype(np.int64)

    def points(self, cells: NDArray[np.int64]) -> NDArray[np.float32]:
        """Return the places float32 [N,3] of cells [N,3]; exact arithmetic, the same on every machine."""
        low, width = np.array(self.low), np.array(self.high) - self.low
        offset = 0.5 if self.anchor == "center" else 0.0
        # A box of no width keeps its place: the centre of its cell is not half a unit away.
        return (low + (cells + offset) * (width * 2.0**-self.depth)).astype(np.float32)


def one_a_voxel(
    codes: NDArray[np.int64],
    rows: Mapping[str, NDArray[Any]],
    importance: NDArray[Any],
    *,
    rule: MergeRule = "mean",
    generator: np.random.Generator,
) -> tuple[NDArray[np.int64], dict[str, NDArray[Any]], NDArray[np.float64]]:
    """Merge the Gaussians that share a voxel, and bring the voxels into the order of their codes.

    codes       [N] Morton codes of their cells
    rows        name -> [N, ...], what is merged; `quats` as rotations
    importance  [N] >= 0
    rule        "mean"; "importance": mean weighted by it; "random": one of them
    generator   of the draws of "random"

    Returns the row [M] of the first Gaussian of each voxel, the merged rows [M, ...] and their importance, the sum of
    the members'. A Gaussian that is alone in its voxel stays as it is, bit for bit.
    """
    order = np.argsort(codes, kind="stable")
    ordered = codes[order]
    starts = np.flatnonzero(np.diff(ordered, prepend=ordered[:1] - 1))
    counts = np.diff(starts, append=len(ordered))
    weights = importance.astype(np.float64)[order]
    merged_importance = np.add.reduceat(weights, starts) if len(starts) else weights
    if rule == "random":
        chosen = order[starts + np.floor(generator.random(len(starts)) * counts).astype(np.int64)]
        return order[starts], {name: array[chosen] for name, array in rows.items()}, merged_importance
    shared = counts > 1
    members = np.repeat(shared, counts)  # of the ordered rows, those that are not alone
    group = np.repeat(np.arange(int(shared.sum())), counts[shared])
    begins = np.flatnonzero(np.diff(group, prepend=-1))
    weight = weights[members] if rule == "importance" else np.ones(len(group))
    total = np.bincount(group, weight)
    weight = np.where(total[group] > 0, weight, 1.0)  # of members that do not matter, none matters more
    total = np.bincount(group, weight)
    found = {}
    for name, array in rows.items():
        own = array[order[starts]]
        if len(group):
            values = array[order[members]].astype(np.float64).reshape(len(group), math.prod(array.shape[1:]))
            if name == QUATS:
                values = _aligned(values, begins[group])
            mean = np.add.reduceat(values * weight[:, None], begins) / total[:, None]
            if name == QUATS:
                mean = _unit(mean)
            own[shared] = mean.reshape(len(begins), *array.shape[1:]).astype(array.dtype)
        found[name] = own
    return order[starts], found, merged_importance


def _unit(quats: NDArray[np.float64]) -> NDArray[np.float64]:
    return quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-30)


def _aligned(quats: NDArray[np.float64], first: NDArray[np.int64]) -> NDArray[np.float64]:
    """Unit quaternions with the sign that is nearer to that of the row `first` [n] of their voxel."""
    unit = _unit(quats)
    return unit * np.where((unit * unit[first]).sum(1, keepdims=True) < 0, -1.0, 1.0)
