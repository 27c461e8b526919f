"""Shapes of splats as the logarithm of their covariance: unique, smooth, and the same relative error for every splat.

L = R diag(ln s) R^T of a splat with rotation R and standard deviations s. Its mean m = tr L / 3 is the size; the
deviator D = L - m I has five orthonormal coordinates d, ||d|| = ||D||. Training moves (d, m); a rasterizer is given the
covariance exp(2L).
"""

from __future__ import annotations

import functools
import math
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)

from sw_wisp.fast.axes import axes as fast_axes

SHAPE = 5
"""Numbers of a deviator."""
SWEEPS = 5
"""Sweeps of the cyclic Jacobi method: enough for float32 and any 3x3 matrix."""
EQUAL = 1e-4
"""Logarithms of axes that lie closer count as equal in the gradient; 2e-9 off."""
SIX = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""Places in a symmetric matrix of the six numbers that stand for it: xx, xy, xz, yy, yz, zz."""
TWICE = (1.0, 2.0, 2.0, 1.0, 2.0, 1.0)
"""How often each of the six stands in the matrix."""


@functools.cache
def _basis(device: torch.device, dtype: torch.dtype) -> Tensor:
    """[6,6]: numbers (d, m) times it are the six of L."""
    a, b = math.sqrt(0.5), math.sqrt(1 / 6)
    rows = [
        [a, 0, 0, -a, 0, 0],  # (D_xx - D_yy) / sqrt 2
        [-b, 0, 0, -b, 0, 2 * b],  # (2 D_zz - D_xx - D_yy) / sqrt 6
        [0, a, 0, 0, 0, 0],  # sqrt 2 D_xy
        [0, 0, a, 0, 0, 0],
        [0, 0, 0, 0, a, 0],
        [1, 0, 0, 1, 0, 1],
    ]
    return torch.tensor(rows, dtype=dtype, device=device)


def six_of(shape: Tensor, size: Tensor) -> Tensor:
    """Return the six numbers [N,6] of L from deviators [N,5] and sizes [N]."""
    return torch.cat([shape, size[:, None]], dim=1) @ _basis(shape.device, shape.dtype)


def numbers_of(six: Tensor) -> tuple[Tensor, Tensor]:
    """Return deviators [N,5] and sizes [N] of matrices L, given by their six numbers [N,6]."""
    basis, twice = _basis(six.device, six.dtype), six.new_tensor(TWICE)
    size = (six * twice) @ basis[SHAPE] / 3
    return (six * twice) @ basis[:SHAPE].T, size


def matrix_of(six: Tensor) -> Tensor:
    """Return symmetric matrices [N,3,3] of their six numbers [N,6]."""
    return six[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].view(-1, 3, 3)


def log_covariance(log_scales: Tensor, quats: Tensor) -> tuple[Tensor, Tensor]:
    """Return deviators [N,5] and sizes [N] of splats.

    log_scales  [N,3] natural logarithms of the standard deviations
    quats       [N,4] w,x,y,z of any norm
    """
    w, x, y, z = F.normalize(quats, dim=1, eps=1e-12).unbind(1)
    rotation = torch.stack([
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ], dim=1).view(-1, 3, 3)  # fmt: skip
    full = (rotation * log_scales[:, None, :]) @ rotation.transpose(1, 2)
    return numbers_of(torch.stack([full[:, i, j] for i, j in SIX], dim=1))


def scales_and_quats(shape: Tensor, size: Tensor) -> tuple[Tensor, Tensor]:
    """Return log scales [N,3], ascending, and unit quaternions [N,4] (w,x,y,z) of splats.

    Axes of equal scales are arbitrary: for the final export, not for anything that learns or is coded.
    """
    six = six_of(shape.detach().double(), size.detach().double())
    found = fast_axes(six)
    if found is not None:
        return found[0].to(size), found[1].to(size)
    values, vectors = jacobi(six)
    values, order = values.sort(dim=1)
    vectors = vectors.gather(2, order[:, None].expand(-1, 3, 3))
    vectors = vectors * torch.det(vectors).sign()[:, None, None]
    return values.to(size), _quaternions(vectors).to(size)


def _quaternions(rotations: Tensor) -> Tensor:
    """Return unit quaternions [N,4] of rotations [N,3,3], w >= 0."""
    xx, yy, zz = (rotations[:, i, i] for i in range(3))
    # Squares of 2w, 2x, 2y, 2z; the largest is at least 1, so that dividing by its root is safe.
    squares = torch.stack([1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz], dim=1)
    r = rotations
    wx, wy, wz = r[:, 2, 1] - r[:, 1, 2], r[:, 0, 2] - r[:, 2, 0], r[:, 1, 0] - r[:, 0, 1]
    xy, xz, yz = r[:, 0, 1] + r[:, 1, 0], r[:, 0, 2] + r[:, 2, 0], r[:, 1, 2] + r[:, 2, 1]
    products = torch.stack([
        squares[:, 0], wx, wy, wz,
        wx, squares[:, 1], xy, xz,
        wy, xy, squares[:, 2], yz,
        wz, xz, yz, squares[:, 3],
    ], dim=1).view(-1, 4, 4)  # row i: four times the i-th number times all four  # fmt: skip
    best = squares.argmax(dim=1)[:, None, None].expand(-1, 1, 4)
    quats = F.normalize(products.gather(1, best).squeeze(1), dim=1)
    return torch.where(quats[:, :1] < 0, -quats, quats)


def jacobi(six: Tensor) -> tuple[Tensor, Tensor]:
    """Return eigenvalues [N,3], in no order, and eigenvectors [N,3,3] (columns) of symmetric matrices [N,6].

    Cyclic Jacobi: vectorised over rows, nothing waits for a device. No gradient.
    """
    rows = six.T.contiguous()  # [6,N]: long rows are fast
    entries = {place: rows[k] for k, place in enumerate(SIX)}
    zeros = torch.zeros_like(rows[0])
    axes = list(torch.eye(3, dtype=six.dtype, device=six.device)[:, :, None].expand(3, 3, len(six)))  # each [3,N]
    tiny = torch.finfo(six.dtype).tiny
    for _ in range(SWEEPS):
        for p, q in ((0, 1), (0, 2), (1, 2)):
            r = 3 - p - q
            pr, qr = (min(p, r), max(p, r)), (min(q, r), max(q, r))
            twice, apart = 2 * entries[p, q], entries[q, q] - entries[p, p]
            t = twice / (apart + torch.copysign(torch.hypot(apart, twice) + tiny, apart))
            c = torch.rsqrt(1 + t * t)
            s = t * c
            shift = t * entries[p, q]
            entries[p, p], entries[q, q] = entries[p, p] - shift, entries[q, q] + shift
            entries[pr], entries[qr] = c * entries[pr] - s * entries[qr], s * entries[pr] + c * entries[qr]
            entries[p, q] = zeros
            axes[p], axes[q] = c * axes[p] - s * axes[q], s * axes[p] + c * axes[q]
    return torch.stack([entries[i, i] for i in range(3)], dim=1), torch.stack(axes).permute(2, 1, 0)


class _Covariance(torch.autograd.Function):
    """exp(2L) of (d, m), eigenvalues of L clamped, with the exact gradient, that of equal eigenvalues included."""

    @staticmethod
    def forward(ctx: Any, shape: Tensor, size: Tensor, low: float, high: float) -> Tensor:
        values, vectors = jacobi(six_of(shape, size))
        ctx.bounds = low, high
        ctx.save_for_backward(values, vectors)
        axes = vectors * values.clamp(low, high).exp()[:, None, :]
        return torch.stack([(axes[:, i] * axes[:, j]).sum(1) for i, j in SIX], dim=1)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, None, None]:  # type: ignore[override]
        values, vectors = ctx.saved_tensors
        low, high = ctx.bounds
        # The six numbers' gradient holds each off-diagonal entry of the symmetric one twice.
        full = matrix_of(grad / grad.new_tensor(TWICE))
        inner = divided_differences(values.clamp(low, high)) * (vectors.transpose(1, 2) @ full @ vectors)
        along = inner.diagonal(dim1=1, dim2=2)  # a view
        # Descent moves against the gradient: what lies outside may only come back.
        outward = ((values > high) & (along < 0)) | ((values < low) & (along > 0))
        along.masked_fill_(outward, 0)
        of_log = vectors @ inner @ vectors.transpose(1, 2)
        six = torch.stack([of_log[:, i, j] for i, j in SIX], dim=1) * grad.new_tensor(TWICE)
        numbers = six @ _basis(grad.device, grad.dtype).T
        return numbers[:, :SHAPE], numbers[:, SHAPE], None, None


def divided_differences(values: Tensor) -> Tensor:
    """Return (e^2a - e^2b) / (a - b) for all pairs of three numbers a, b: [N,3] to [N,3,3], symmetric.

    As 2 e^(a+b) sinh(a - b) / (a - b): nothing is subtracted from its like.
    """
    apart = values[:, :, None] - values[:, None, :]
    mean = 2 * torch.exp(values[:, :, None] + values[:, None, :])
    near = apart.abs() < EQUAL
    safe = apart.masked_fill(near, 1.0)
    return mean * torch.where(near, 1.0, torch.sinh(safe) / safe)


def covariance(shape: Tensor, size: Tensor, low: float, high: float) -> Tensor:
    """Return covariances exp(2L) [N,6], world units squared, upper triangle xx,xy,xz,yy,yz,zz; differentiable.

    shape, size     [N,5] and [N]
    low, high       bounds of the logarithms of the standard deviations; beyond them the gradient passes that leads
                    back
    """
    found: Tensor = _Covariance.apply(shape, size, low, high)
    return found


@torch.no_grad()
def bounded(shape: Tensor, size: Tensor, low: float, high: float) -> tuple[Tensor, Tensor]:
    """Return (d, m) whose log scales are clamped to [low, high]; rows inside stay as they are."""
    values, vectors = jacobi(six_of(shape, size))
    axes = vectors @ (values.clamp(low, high)[:, :, None] * vectors.transpose(1, 2))
    inside = ((values >= low) & (values <= high)).all(dim=1)
    new_shape, new_size = numbers_of(torch.stack([axes[:, i, j] for i, j in SIX], dim=1))
    return torch.where(inside[:, None], shape, new_shape), torch.where(inside, size, new_size)
