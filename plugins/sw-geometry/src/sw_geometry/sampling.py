"""Points on a mesh: by the grid of the DTU protocol, or uniformly by area; and the thinning of points."""

from __future__ import annotations

import numpy as np

from sw_geometry.mesh import Floats, Indices, Mesh

CHUNK = 20_000
"""Points that neighbours are looked up for at a time: bounds the memory."""


def grid_samples(mesh: Mesh, step: float) -> Floats:
    """Points about `step` apart on every triangle, and all vertices, [n,3].

    Of a triangle with edges v1, v2 from its first corner, of lengths l1, l2, and A = |v1 x v2| > 0: with
    s = step sqrt(l1 l2 / A), n1 = l1 // s and n2 = l2 // s, the points v0 + v1 (i + .5) / n1 + v2 (j + .5) / n2 whose
    two fractions sum to less than 1.

    Source: DTU evaluation (Jensen et al., CVPR 2014) as Python code of it samples meshes.
    """
    corners = mesh.corners
    v0, v1, v2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = np.linalg.norm(np.cross(v1, v2), axis=1)
    v0, v1, v2, area = (each[area > 0] for each in (v0, v1, v2, area))
    l1, l2 = np.linalg.norm(v1, axis=1), np.linalg.norm(v2, axis=1)
    spacing = step * np.sqrt(l1 * l2 / area)
    counts = np.stack([l1 // spacing, l2 // spacing], axis=1).astype(np.int64)  # [F,2]
    inside = (counts > 0).all(axis=1)
    found = [mesh.vertices]
    pairs, group_of = np.unique(counts[inside], axis=0, return_inverse=True)
    order = np.argsort(group_of.ravel(), kind="stable")
    bounds = np.searchsorted(group_of.ravel()[order], np.arange(len(pairs) + 1))
    at = np.flatnonzero(inside)[order]
    for (n1, n2), begin, end in zip(pairs, bounds[:-1], bounds[1:], strict=True):
        a, b = np.meshgrid((np.arange(n1 + 1) + 0.5) / n1, (np.arange(n2 + 1) + 0.5) / n2, indexing="ij")
        kept = a + b < 1
        a, b = a[kept][:, None], b[kept][:, None]  # [k,1]
        rows = at[begin:end]
        points = v0[rows, None] + a * v1[rows, None] + b * v2[rows, None]  # [rows,k,3]
        found.append(points.reshape(-1, 3))
    return np.concatenate(found)


def uniform_samples(mesh: Mesh, count: int, seed: int = 0) -> tuple[Floats, Indices]:
    """`count` points [count,3] uniform by area, stratified, and the triangles [count] that they lie on.

    Equal meshes in equal order give equal points. Raises ValueError for a mesh without area.
    """
    reach = np.cumsum(mesh.areas())
    if not len(reach) or reach[-1] <= 0:
        raise ValueError("a mesh without area has no points")
    generator = np.random.default_rng(seed)
    where = (np.arange(count) + generator.random(count)) / count * reach[-1]
    rows = np.minimum(np.searchsorted(reach, where, side="right"), len(reach) - 1)
    root, v = np.sqrt(generator.random(count)), generator.random(count)
    weights = np.stack([1 - root, root * (1 - v), root * v], axis=1)
    points = (mesh.corners[rows] * weights[:, :, None]).sum(axis=1)
    return points, rows


def thinned(points: Floats, radius: float, seed: int = 0) -> Floats:
    """Points of which no two are within `radius` (<=) of each other, each dropped one within it of a kept one.

    Greedy in an order shuffled by `seed`: a point is kept if no point kept before it is within the radius.
    Source: DTU evaluation (Jensen et al., CVPR 2014), whose order is not seeded.
    """
    from scipy.spatial import cKDTree

    shuffled = points[np.random.default_rng(seed).permutation(len(points))]
    tree = cKDTree(shuffled)
    kept = np.ones(len(shuffled), dtype=bool)
    for begin in range(0, len(shuffled), CHUNK):
        rows = np.arange(begin, min(begin + CHUNK, len(shuffled)))
        rows = rows[kept[rows]]
        for row, near in zip(rows, tree.query_ball_point(shuffled[rows], radius), strict=True):
            if kept[row]:
                kept[near] = False
                kept[row] = True
    return shuffled[kept]


def grid_thinned(points: Floats, size: float, origin: Floats) -> Floats:
    """At most one point of each cell of a grid: the one nearest to the cell's centre.

    size    edge of a cell; origin [3] a corner of the grid

    Source: TrimGS (arXiv 2406.07499), point-cloud evaluation.
    """
    cells = np.floor((points - origin) / size).astype(np.int64)
    from_centre = np.linalg.norm(points - (origin + (cells + 0.5) * size), axis=1)
    order = np.lexsort((from_centre, cells[:, 2], cells[:, 1], cells[:, 0]))
    first = np.ones(len(order), dtype=bool)
    first[1:] = (cells[order][1:] != cells[order][:-1]).any(axis=1)
    return points[np.sort(order[first])]
