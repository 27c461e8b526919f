"""The tree of places: boxes that hold a share of the Gaussians of all levels, halved until each is small."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sw_gaussians.covariances import covariances_of
from sw_interchange.order import morton_order
from sw_interchange.scene import GaussianScene

Rows = NDArray[np.intp]


@dataclass
class Node:
    """A place.

    low, high   [3] box around its Gaussians out to one standard deviation
    children    two halves, or none of a leaf
    rows        of a leaf: the rows of each level, in Morton order
    """

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    children: tuple[Node, Node] | None
    rows: list[Rows]


def build_tree(levels: Sequence[GaussianScene], most: int) -> Node:
    """Halve the place of all levels along its longest side until no part has more than `most` Gaussians.

    levels  scenes in the same frame, none without Gaussians
    most    Gaussians of a leaf, all levels together
    """
    means = np.concatenate([scene.means for scene in levels]).astype(np.float64)
    reach = np.concatenate([_reach(scene) for scene in levels])
    starts = np.cumsum([0, *(scene.num_gaussians for scene in levels)])
    return _node(means, reach, starts, np.arange(len(means)), most)


def _reach(scene: GaussianScene) -> NDArray[Any]:
    """[N,3] half sides of the boxes around the ellipsoids of one standard deviation."""
    with np.errstate(over="ignore"):
        scales = np.exp(scene.log_scales.astype(np.float64))
    found: NDArray[Any] = np.sqrt(np.einsum("nii->ni", covariances_of(scene.quats.astype(np.float64), scales)))
    return found


def _node(means: NDArray[Any], reach: NDArray[Any], starts: NDArray[Any], rows: Rows, most: int) -> Node:
    places = means[rows]
    low, high = places.min(axis=0), places.max(axis=0)
    axis = int((high - low).argmax())
    if len(rows) > most and high[axis] > low[axis]:
        half = len(rows) // 2
        order = np.argpartition(places[:, axis], half)
        # Level by level and row by row, whatever order the partition leaves.
        parts = [np.sort(rows[order[:half]]), np.sort(rows[order[half:]])]
        first, second = (_node(means, reach, starts, part, most) for part in parts)
        return Node(np.minimum(first.low, second.low), np.maximum(first.high, second.high), (first, second), [])
    extent = reach[rows]
    bounds = np.searchsorted(rows, starts)
    of_levels = [rows[a:b] - start for a, b, start in zip(bounds, bounds[1:], starts, strict=False)]
    sorted_rows = [
        part[morton_order(means[part + start])] if len(part) else part
        for part, start in zip(of_levels, starts, strict=False)
    ]
    return Node((places - extent).min(axis=0), (places + extent).max(axis=0), None, sorted_rows)


def leaves_of(node: Node) -> list[Node]:
    """Leaves from left to right: neighbours in the list are neighbours in space."""
    if node.children is None:
        return [node]
    return [leaf for child in node.children for leaf in leaves_of(child)]
