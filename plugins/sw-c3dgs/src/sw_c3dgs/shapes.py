"""A Gaussian's covariance as a size times a normalised shape: factor^2 R diag(s^2) R^T with |s| = 1, so of trace 1.

Covariances are upper triangles [n,6]: xx, xy, xz, yy, yz, zz.
Source: C3DGS (arXiv 2401.02436), section on sensitivity-aware vector clustering.
"""

from __future__ import annotations

import torch
from sw_reference.projection import covariances
from torch import Tensor

UPPER = (0, 1, 2, 4, 5, 8)
FULL = (0, 1, 2, 1, 3, 4, 2, 4, 5)
DIAGONAL = (0, 3, 5)
BLOCK = 1 << 16  # matrices that are decomposed at a time
TINY = 1e-8


def split_scales(log_scales: Tensor) -> tuple[Tensor, Tensor]:
    """Log factors [n] and shapes [n,3] >= 0 of unit length for log scales [n,3]: log scale = log factor + log shape."""
    largest = log_scales.amax(1, keepdim=True)
    relative = torch.exp(log_scales - largest)
    norm = torch.linalg.vector_norm(relative, dim=1, keepdim=True)
    return (largest + norm.log())[:, 0], relative / norm


def normalised_covariances(shapes: Tensor, quats: Tensor) -> Tensor:
    """[n,6], of trace 1 for shapes [n,3] of unit length; quats [n,4] of any norm. Differentiable."""
    return covariances(shapes, quats).flatten(1)[:, UPPER]


def of_trace_one(found: Tensor) -> Tensor:
    """Covariances [n,6] divided by their trace; those whose trace is not positive stay as they are.

    Paper's code divides by any trace. The codebook starts from random numbers, some of whose traces are near 0 or
    negative; the division would throw these entries far away, from where no row calls them back.
    """
    trace = found[:, DIAGONAL].sum(1, keepdim=True)
    return torch.where(trace > TINY, found / trace.clamp_min(TINY), found)


def decomposed(found: Tensor) -> tuple[Tensor, Tensor]:
    """Shapes [n,3] of unit length, ascending, and unit quaternions [n,4] (w,x,y,z), w >= 0, of covariances [n,6].

    Eigenvalues that are not positive, as of a codebook entry that is no covariance, become 1e-12.
    """
    parts = [_decomposed(block) for block in torch.split(found.detach().double(), BLOCK)]
    if not parts:
        return found.new_zeros(0, 3), found.new_zeros(0, 4)
    shapes, quats = (torch.cat(each).to(found.dtype) for each in zip(*parts, strict=True))
    return shapes, quats


def _decomposed(found: Tensor) -> tuple[Tensor, Tensor]:
    matrices = found[:, FULL].reshape(-1, 3, 3)
    values, axes = torch.linalg.eigh(matrices + TINY * torch.eye(3, dtype=found.dtype, device=found.device))
    axes = axes * torch.linalg.det(axes)[:, None, None]  # of three axes all signs may flip: then a rotation
    shapes = values.clamp_min(1e-12).sqrt()
    return torch.nn.functional.normalize(shapes, dim=1), _quaternions(axes)


def _quaternions(rotations: Tensor) -> Tensor:
    """Unit quaternions [n,4], w >= 0, of rotation matrices [n,3,3]: by the largest of the four candidates."""
    xx, yy, zz = rotations[:, 0, 0], rotations[:, 1, 1], rotations[:, 2, 2]
    a, b, c = (rotations[:, i, j] - rotations[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0)))
    d, e, f = (rotations[:, i, j] + rotations[:, j, i] for i, j in ((1, 0), (0, 2), (2, 1)))
    candidates = torch.stack(  # row k is 4 q_k q
        [
            torch.stack([1 + xx + yy + zz, a, b, c], 1),
            torch.stack([a, 1 + xx - yy - zz, d, e], 1),
            torch.stack([b, d, 1 - xx + yy - zz, f], 1),
            torch.stack([c, e, f, 1 - xx - yy + zz], 1),
        ],
        1,
    )
    largest = candidates.diagonal(dim1=1, dim2=2).argmax(1)
    found = candidates[torch.arange(len(candidates), device=candidates.device), largest]
    found = torch.nn.functional.normalize(found, dim=1)
    return torch.where(found[:, :1] < 0, -found, found)
