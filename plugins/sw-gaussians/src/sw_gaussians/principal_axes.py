"""Principal axes of many small symmetric matrices, such as covariances, and the quaternions of rotations."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize

SWEEPS = 6
"""Of rotations over the three pairs of axes; four are usual in float64, since each squares what is left."""


def principal_axes(matrices: Tensor) -> tuple[Tensor, Tensor]:
    """Return eigenvalues [N,3], ascending, and rotations [N,3,3] whose columns are the axes, on their device.

    matrices    [N,3,3] symmetric
    """
    if matrices.device.type != "cpu":  # solvers of a GPU take 530 kB of memory for each matrix
        return axes_by_turns(matrices)
    values, axes = torch.linalg.eigh(matrices)
    return values, axes * torch.linalg.det(axes)[:, None, None]  # of three axes all signs may flip: then a rotation


def axes_by_turns(matrices: Tensor) -> tuple[Tensor, Tensor]:
    """As `principal_axes`, all matrices at once: each turn of two axes clears one entry (Jacobi's method)."""
    diagonal = list(matrices.diagonal(dim1=1, dim2=2).unbind(1))
    beside = [matrices[:, 1, 2], matrices[:, 0, 2], matrices[:, 0, 1]]  # of the two axes that are not the place
    axes = list(torch.eye(3, dtype=matrices.dtype, device=matrices.device).expand(len(matrices), 3, 3).unbind(2))
    for _ in range(SWEEPS):
        for p, q, r in ((0, 1, 2), (0, 2, 1), (1, 2, 0)):
            half = (diagonal[q] - diagonal[p]) / 2
            longest = half.abs() + torch.hypot(half, beside[r])
            tangent = torch.where(longest > 0, beside[r] / longest, 0).copysign(half * beside[r])
            cosine = torch.rsqrt(tangent * tangent + 1)
            sine = tangent * cosine
            change = tangent * beside[r]
            diagonal[p], diagonal[q] = diagonal[p] - change, diagonal[q] + change
            beside[p], beside[q] = sine * beside[q] + cosine * beside[p], cosine * beside[q] - sine * beside[p]
            beside[r] = torch.zeros_like(change)
            c, s = cosine[:, None], sine[:, None]
            axes[p], axes[q] = c * axes[p] - s * axes[q], s * axes[p] + c * axes[q]
    values, order = torch.stack(diagonal, dim=1).sort(dim=1)
    first, second = torch.stack(axes, dim=1).gather(1, order[:, :2, None].expand(-1, 2, 3)).unbind(1)
    return values, torch.stack([first, second, torch.linalg.cross(first, second)], dim=2)


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
