"""Distances from points to points and to triangles."""

from __future__ import annotations

import numpy as np

from sw_geometry.mesh import Floats, Indices, Mesh

FIRST, MOST = 8, 1024
"""Triangles that are looked at for a point: at first, and before the search is given up."""
PAIRS = 400_000
"""Pairs of point and triangle that are computed at a time: bounds the memory."""


def nearest_points(queries: Floats, points: Floats) -> tuple[Floats, Indices]:
    """Distance [n] from each query [n,3] to the nearest of `points` [m,3], and its row [n]; inf, m if there is none."""
    from scipy.spatial import cKDTree

    if not len(points):
        return np.full(len(queries), np.inf), np.zeros(len(queries), dtype=np.int64)
    distance, row = cKDTree(points).query(queries)
    return np.asarray(distance), np.asarray(row)


def to_triangles(queries: Floats, mesh: Mesh) -> tuple[Floats, Indices]:
    """Distance [n] from each query [n,3] to the surface of a mesh, and the nearest triangle [n]; inf, -1 without one.

    Triangles are sought by their centres, in classes of about equal size, until none that is farther can be nearer.
    A point so far away that more than 1,024 centres would have to be tried gets the best of those: too much by at
    most the radius of the largest triangle.
    """
    from scipy.spatial import cKDTree

    best, which = np.full(len(queries), np.inf), np.full(len(queries), -1, dtype=np.int64)
    corners = mesh.corners
    centres = corners.mean(axis=1)
    radii = np.linalg.norm(corners - centres[:, None], axis=2).max(axis=1, initial=0.0)
    with np.errstate(divide="ignore"):
        classes = np.floor(np.log2(radii)) if len(radii) else radii
    for each in np.unique(classes):
        rows = np.flatnonzero(classes == each)
        tree, reach = cKDTree(centres[rows]), float(radii[rows].max())
        open_, tried = np.arange(len(queries)), min(FIRST, len(rows))
        while len(open_):
            unsettled = []
            for begin in range(0, len(open_), max(PAIRS // tried, 1)):
                at = open_[begin : begin + max(PAIRS // tried, 1)]
                far, near = tree.query(queries[at], k=tried)
                far, near = far.reshape(len(at), tried), near.reshape(len(at), tried)
                distance = point_triangle(np.repeat(queries[at], tried, axis=0), corners[rows[near.ravel()]])
                distance = distance.reshape(len(at), tried)
                column = distance.argmin(axis=1)
                found = distance[np.arange(len(at)), column]
                closer = found < best[at]
                best[at[closer]] = found[closer]
                which[at[closer]] = rows[near[np.arange(len(at)), column]][closer]
                unsettled.append(at[best[at] > far[:, -1] - reach])
            if tried >= min(MOST, len(rows)):
                break
            open_, tried = np.concatenate(unsettled), min(4 * tried, MOST, len(rows))
    return best, which


def point_triangle(points: Floats, corners: Floats) -> Floats:
    """Distance [n] from each of points [n,3] to its own triangle, corners [n,3,3]; degenerate triangles are fine."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    normal = np.cross(b - a, c - a)
    squared = (normal * normal).sum(axis=1)
    inside = squared > 0
    edges = np.stack([_to_segment(points, p, q) for p, q in ((a, b), (b, c), (c, a))])
    for p, q in ((a, b), (b, c), (c, a)):  # on the inner side of every edge: the foot lies in the triangle
        inside &= (np.cross(q - p, points - p) * normal).sum(axis=1) >= 0
    height = np.abs(((points - a) * normal).sum(axis=1)) / np.sqrt(np.where(squared > 0, squared, 1.0))
    return np.asarray(np.where(inside, height, edges.min(axis=0)))


def _to_segment(points: Floats, p: Floats, q: Floats) -> Floats:
    way = q - p
    length = (way * way).sum(axis=1)
    t = ((points - p) * way).sum(axis=1) / np.where(length > 0, length, 1.0)
    return np.asarray(np.linalg.norm(points - p - np.clip(t, 0, 1)[:, None] * way, axis=1))
