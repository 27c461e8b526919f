"""Outliers of a cloud by the Local Outlier Factor (Breunig et al., SIGMOD 2000)."""

from __future__ import annotations

import numpy as np

DENSITY_FLOOR = 1e-10
"""Added to mean reachability distances, so that duplicates have a density; the value of scikit-learn."""


def local_outlier_factor(points: np.ndarray, neighbors: int = 50) -> np.ndarray:
    """[N] float64: about 1 within a cluster, larger the further a point lies from where its neighbours are dense.

    points      [N,D], finite
    neighbors   how many nearest other points are looked at; at most N - 1

    With reach(p, o) = max(distance of o to its k-th neighbour, |p - o|) and the density of p being 1 / mean of
    reach(p, .) over its neighbours, it is the mean density of the neighbours over the point's own.
    """
    n = len(points)
    k = min(neighbors, n - 1)
    if k < 1:
        return np.ones(n)
    from scipy.spatial import cKDTree  # here, so that a process that only decodes does not import it

    distances, index = cKDTree(points).query(points, k=k + 1)
    # The nearest is the point itself (or a duplicate of it, at the same distance 0).
    distances, index = distances[:, 1:], index[:, 1:]
    reach = np.maximum(distances[index, -1], distances)
    density = 1 / (reach.mean(axis=1) + DENSITY_FLOOR)
    return density[index].mean(axis=1) / density


def inliers(points: np.ndarray, *, neighbors: int = 50, contamination: float = 0.05) -> np.ndarray:
    """[N] bool: all but the share `contamination` of points with the highest Local Outlier Factor."""
    factor = local_outlier_factor(points, neighbors)
    return factor <= np.quantile(factor, 1 - contamination) if len(points) else np.ones(0, bool)
