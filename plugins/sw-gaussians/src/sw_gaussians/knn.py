"""Exact nearest neighbours in space."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


def mean_squared_neighbor_distance(points: Tensor, neighbors: int = 3) -> Tensor:
    """Return the mean squared distance to the nearest *other* points, [N] float32 on the device of `points`.

    points      [N,3], finite
    neighbors   how many; with fewer other points those there are, with none 0. A duplicate counts, at distance 0

    Exact (k-d tree on the CPU, float64), no gradient.
    """
    n = points.shape[0]
    k = min(neighbors, n - 1)
    if k < 1:
        return torch.zeros(n, dtype=torch.float32, device=points.device)
    from scipy.spatial import cKDTree  # here, so that a process that only decodes does not import it

    xyz = points.detach().cpu().numpy().astype(np.float64)
    # k + 1: every point is its own nearest neighbour, at distance 0. Among duplicates the tree may name another
    # one first, which changes nothing: the distance is the same 0.
    distances, _ = cKDTree(xyz).query(xyz, k=k + 1)
    squared = (distances[:, 1:] ** 2).mean(axis=1)
    return torch.from_numpy(squared.astype(np.float32)).to(points.device)


def nearest_neighbors(points: Tensor, neighbors: int) -> Tensor:
    """Return indices of the nearest points, [N,k] int32, same device, the point itself (or a duplicate) first.

    points      [N,3], finite
    neighbors   k, the point itself included; fewer where there are fewer points

    Exact (k-d tree on the CPU, float64).
    """
    n = points.shape[0]
    k = min(neighbors, n)
    if k < 1:
        return torch.zeros(n, 0, dtype=torch.int32, device=points.device)
    from scipy.spatial import cKDTree  # here, as above

    xyz = points.detach().cpu().numpy().astype(np.float64)
    _, found = cKDTree(xyz).query(xyz, k=k, workers=-1)
    return torch.from_numpy(found.reshape(n, k).astype(np.int32)).to(points.device)
