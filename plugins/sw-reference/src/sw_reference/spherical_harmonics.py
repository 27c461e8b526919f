"""Real spherical harmonics up to degree 3, in the sign convention of 3DGS."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from splatwizard_core.api import SH, SH_C0, ShapeError

C1 = 0.4886025119029199
C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
C3 = (
    -0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154,
    -0.4570457994644658, 1.445305721320277, -0.5900435899266435,
)  # fmt: skip


def sh_basis(directions: Tensor, degree: int) -> Tensor:
    """Values of the basis functions B_k, [N,3] unit vectors -> [N,(degree+1)^2]. Source: 3DGS (arXiv 2308.04079)."""
    x, y, z = directions.unbind(-1)
    basis = [torch.full_like(x, SH_C0)]
    if degree >= 1:
        basis += [-C1 * y, C1 * z, -C1 * x]
    if degree >= 2:
        xx, yy, zz, xy, yz, xz = x * x, y * y, z * z, x * y, y * z, x * z
        basis += [C2[0] * xy, C2[1] * yz, C2[2] * (2 * zz - xx - yy), C2[3] * xz, C2[4] * (xx - yy)]
    if degree >= 3:
        basis += [
            C3[0] * y * (3 * xx - yy),
            C3[1] * xy * z,
            C3[2] * y * (4 * zz - xx - yy),
            C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
            C3[4] * x * (4 * zz - xx - yy),
            C3[5] * z * (xx - yy),
            C3[6] * x * (xx - 3 * yy),
        ]
    return torch.stack(basis, dim=-1)


def eval_sh(sh: Tensor, directions: Tensor, active_degree: int) -> Tensor:
    """Sum of the active bands, without the 0.5 that makes it a colour; differentiable.

    sh             [N,K,3], K = 1, 4, 9 or 16
    directions     [N,3] unit vectors, from the camera to the Gaussian
    active_degree  bands above it are ignored and get exactly zero gradient; capped by what K holds

    Returns [N,3]. Raises ShapeError if K is no square of 1 to 4.
    """
    if sh.dim() != 3 or sh.shape[-1] != 3:
        raise ShapeError(f"sh must be [N,K,3], got {list(sh.shape)}")
    if sh.shape[1] not in (1, 4, 9, 16):
        raise ShapeError(f"{sh.shape[1]} SH coefficients belong to no degree from 0 to 3; expected 1, 4, 9 or 16")
    degree = min(active_degree, math.isqrt(sh.shape[1]) - 1)
    basis = sh_basis(directions, degree)  # [N, k]
    return (basis[:, :, None] * sh[:, : basis.shape[1]]).sum(dim=1)


def sh_colors(sh: SH, center: Tensor, means: Tensor, *, rows: Tensor | None = None, clamp: bool = True) -> Tensor:
    """Return colours as seen from `center`: max(0, 0.5 + SH), [N,3]; differentiable in coefficients and `means`.

    center  [3] camera centre, world units, not on a mean
    means   [N,3] world units
    rows    which Gaussians; None: all
    clamp   False leaves negative values (sensitivity passes)
    """
    dense = sh.to_dense()
    if rows is not None:
        dense, means = dense[rows], means[rows]
    raw = eval_sh(dense, torch.nn.functional.normalize(means - center, dim=-1), sh.active_degree) + 0.5
    # clamp's gradient passes at raw == 0, as the specification wants.
    return raw.clamp(min=0) if clamp else raw
