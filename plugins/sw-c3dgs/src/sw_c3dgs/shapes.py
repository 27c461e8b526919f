"""A Gaussian's covariance as a size times a normalised shape: factor^2 R diag(s^2) R^T with |s| = 1, so of trace 1.

Covariances are upper triangles [n,6]: xx, xy, xz, yy, yz, zz.
Source: C3DGS (arXiv 2401.02436), section on sensitivity-aware vector clustering.
"""

from __future__ import annotations

import torch
from sw_gaussians.principal_axes import principal_axes, quaternions
from sw_reference.projection import covariances
from torch import Tensor

UPPER = (0, 1, 2, 4, 5, 8)
FULL = (0, 1, 2, 1, 3, 4, 2, 4, 5)
DIAGONAL = (0, 3, 5)
BLOCK = 1 << 16  # matrices whose shapes are found at a time
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
    values, axes = principal_axes(matrices + TINY * torch.eye(3, dtype=found.dtype, device=found.device))
    shapes = values.clamp_min(1e-12).sqrt()
    return torch.nn.functional.normalize(shapes, dim=1), quaternions(axes)
