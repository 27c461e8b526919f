"""Schedule tasks of the regularisation by normals: when they are drawn, and whose neighbours are whose."""

import numpy as np
import torch
from torch import Tensor

from sw_trimgs.flat import FlatGaussians


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
    from scipy.spatial import cKDTree  # here, so that a process that only decodes does not import it

    xyz = points.detach().cpu().numpy().astype(np.float64)
    _, found = cKDTree(xyz).query(xyz, k=k, workers=-1)
    return torch.from_numpy(found.reshape(n, k).astype(np.int32)).to(points.device)


class DrawSurface:
    """Has depth and normals drawn beside the colours, and finds each Gaussian's neighbours where they are unknown.

    neighbors   how many, the Gaussian itself included
    first       step of this run at which the regularisation begins
    refresh     steps after which they are searched anew though no row has come or gone

    It runs at every step, so that a resumed training goes on as before; the list is a buffer of the model.
    """

    def __init__(self, neighbors: int, *, first: int, refresh: int) -> None:
        self.neighbors, self.first, self.refresh = neighbors, first, refresh

    def __call__(self, model: FlatGaussians, step: int) -> None:
        model.draws_surface = True
        if len(model.neighbors) != model.num_rows or (step - self.first) % self.refresh == 0:
            model.neighbors = nearest_neighbors(model.means, self.neighbors)


def forget_neighbors(model: FlatGaussians) -> None:
    """Drop the list of neighbours, as rows came or went."""
    model.forget_neighbors()
