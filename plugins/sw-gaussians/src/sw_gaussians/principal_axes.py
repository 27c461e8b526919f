"""Principal axes of many small symmetric matrices, such as covariances, and the quaternions of rotations."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize

AT_ONCE = 1 << 15
"""Matrices that a solver gets. That of the GPU fails for twice as many: CUSOLVER_STATUS_INTERNAL_ERROR, torch 2.11."""


def principal_axes(matrices: Tensor) -> tuple[Tensor, Tensor]:
    """Return eigenvalues [N,3], ascending, and rotations [N,3,3] whose columns are the axes, on their device.

    matrices    [N,3,3] symmetric
    """
    parts = [torch.linalg.eigh(part) for part in torch.split(matrices, AT_ONCE)]
    values, axes = (torch.cat(each) for each in zip(*parts, strict=True))
    return values, axes * torch.linalg.det(axes)[:, None, None]  # of three axes all signs may flip: then a rotation


def quaternions(rotations: Tensor) -> Tensor:
    """Return unit quaternions [N,4] (w,x,y,z, w >= 0) of rotations [N,3,3], by the largest of four candidates."""
    r = rotations
    xx, yy, zz = r[:, 0, 0], r[:, 1, 1], r[:, 2, 2]
    a, b, c = (r[:, i, j] - r[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0)))
    d, e, f = (r[:, i, j] + r[:, j, i] for i, j in ((1, 0), (0, 2), (2, 1)))
    candidates = torch.stack([
        1 + xx + yy + zz, a, b, c,
        a, 1 + xx - yy - zz, d, e,
        b, d, 1 - xx + yy - zz, f,
        c, e, f, 1 - xx - yy + zz,
    ], dim=1).view(-1, 4, 4)  # row k is 4 q_k q  # fmt: skip
    largest = candidates.diagonal(dim1=1, dim2=2).argmax(dim=1)
    found = normalize(candidates.gather(1, largest[:, None, None].expand(-1, 1, 4))[:, 0], dim=1)
    return torch.where(found[:, :1] < 0, -found, found)
