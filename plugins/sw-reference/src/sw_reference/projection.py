"""From Gaussians in the world to ellipses on the screen: EWA projection, culling, radii and tile rectangles."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from splatwizard_core.api import Camera, GaussianInputs, RasterOptions

JAC_CLAMP_MARGIN = 0.3
"""Slopes in the Jacobian are clamped this share of tan(fov/2) outside the image (1.3 tan(fov/2) when centred)."""
RADIUS_SIGMA = 3.0
LAMBDA_FLOOR = 0.1
"""Under the root of the larger eigenvalue; makes isotropic splats a little larger (a quirk that is kept)."""
COMP_FLOOR = 2.5e-5
"""Floor under the root of the antialias factor: 0.005 squared."""
CLASSIC_TILE = 16
MAX_RADIUS = 2**30


@dataclass
class Projection:
    """Visible Gaussians on the screen, in input order.

    rows      [V] int64, which inputs are visible
    u         [V,2] pixels, (i + 0.5) is the centre of pixel i
    cov2d     [V,3] xx, xy, yy with the low-pass, px^2
    conic     [V,3] its inverse
    opacity   [V] effective (antialias factor included)
    depth     [V] camera z, world units
    rect      [V,4] int64 x0, y0, x1, y1: classic 16x16 tiles, x0 <= x < x1
    radii     [N] int32, 0 = culled
    n_invalid how many inputs were culled because a value is not finite
    """

    rows: Tensor
    u: Tensor
    cov2d: Tensor
    conic: Tensor
    opacity: Tensor
    depth: Tensor
    rect: Tensor
    radii: Tensor
    n_invalid: int


def rotation_matrices(quats: Tensor) -> Tensor:
    """[V,4] (w,x,y,z) of any non-zero norm -> [V,3,3], local axes to world."""
    w, x, y, z = (quats / torch.linalg.vector_norm(quats, dim=-1, keepdim=True)).unbind(-1)
    return torch.stack(
        [
            1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
        ],
        dim=-1,
    ).reshape(-1, 3, 3)  # fmt: skip


def covariances(scales: Tensor, quats: Tensor, modifier: float = 1.0) -> Tensor:
    """S = M M^T with M = R(q) diag(modifier * s); scales [V,3], quats [V,4] -> [V,3,3]."""
    M = rotation_matrices(quats) * (modifier * scales)[:, None, :]
    return M @ M.transpose(1, 2)


def _matrix_from_upper(cov3d: Tensor) -> Tensor:
    return cov3d[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)


def _world_covariances(g: GaussianInputs, rows: Tensor, modifier: float) -> Tensor:
    if g.cov3d is not None:
        return _matrix_from_upper(g.cov3d[rows])
    assert g.scales is not None
    assert g.quats is not None
    at = rows if g.geom_indices is None else g.geom_indices[rows]
    scales = g.scales[at]
    if g.scale_factors is not None:
        scales = scales * g.scale_factors[rows, None]
    return covariances(scales, g.quats[at], modifier)


def _screen(means: Tensor, S: Tensor, cam: Camera, *, dgr_gradient: bool) -> tuple[Tensor, Tensor, Tensor]:
    """(t [V,3], u [V,2], 2-D covariance without low-pass [V,3] as xx, xy, yy)."""
    t = means @ cam.R.T + cam.tau
    tx, ty, tz = t.unbind(-1)
    tan_x, tan_y = cam.tan_half_fov

    def slope(q: Tensor, focal: float, principal: float, size: int, tan: float) -> Tensor:
        """q/tz^2 with q/tz clamped: the third column of the Jacobian over -focal."""
        low = -(principal / focal + JAC_CLAMP_MARGIN * tan)
        high = (size - principal) / focal + JAC_CLAMP_MARGIN * tan
        clamped = (q / tz).clamp(low, high)
        if dgr_gradient:
            # The original differentiates q/tz^2 with q fixed even where the clamp makes q depend on tz.
            q = torch.where((q / tz < low) | (q / tz > high), (clamped * tz).detach(), q)
            return q / (tz * tz)
        return clamped / tz

    zero = torch.zeros_like(tz)
    J = torch.stack(
        [
            cam.fx / tz, zero, -cam.fx * slope(tx, cam.fx, cam.cx, cam.width, tan_x),
            zero, cam.fy / tz, -cam.fy * slope(ty, cam.fy, cam.cy, cam.height, tan_y),
        ],
        dim=-1,
    ).reshape(-1, 2, 3)  # fmt: skip
    A = J @ cam.R
    c = A @ S @ A.transpose(1, 2)
    u = torch.stack([cam.fx * tx / tz + cam.cx, cam.fy * ty / tz + cam.cy], dim=-1)
    return t, u, torch.stack([c[:, 0, 0], c[:, 0, 1], c[:, 1, 1]], dim=-1)


def _determinant(c: Tensor) -> Tensor:
    return c[:, 0] * c[:, 2] - c[:, 1] * c[:, 1]


def _add_low_pass(c: Tensor, eps2d: float) -> Tensor:
    return c + c.new_tensor([eps2d, 0.0, eps2d])


def finite_rows(g: GaussianInputs, geometry_only: bool) -> Tensor:
    """[N] bool: every value that belongs to the row is finite."""

    def finite(x: Tensor) -> Tensor:
        return torch.isfinite(x).flatten(1).all(dim=1) if x.dim() > 1 else torch.isfinite(x)

    ok = finite(g.means)
    for name, x in g.tensors().items():
        if name in ("means", "geom_indices", "sh.indices", "visible"):
            continue
        if geometry_only and name not in ("scales", "quats", "cov3d", "scale_factors"):
            continue
        if name in ("scales", "quats") and g.geom_indices is not None:
            ok = ok & finite(x)[g.geom_indices]
        elif name == "sh.codebook":
            assert g.sh is not None
            assert g.sh.indices is not None
            ok = ok & finite(x)[g.sh.indices]
        else:
            ok = ok & finite(x)
    return ok


def tile_rectangle(u: Tensor, radius: Tensor, cam: Camera) -> Tensor:
    """The classic square of 16x16 tiles, [V,4] int64, in the pixel frame of the original (centres at integers)."""
    p = u - 0.5
    grid = p.new_tensor([-(-cam.width // CLASSIC_TILE), -(-cam.height // CLASSIC_TILE)])
    first = torch.minimum(torch.trunc((p - radius[:, None]) / CLASSIC_TILE).clamp(min=0), grid)
    last = torch.minimum(torch.trunc((p + radius[:, None] + CLASSIC_TILE - 1) / CLASSIC_TILE).clamp(min=0), grid)
    return torch.cat([first, last], dim=1).long()


@torch.no_grad()
def _cull(
    g: GaussianInputs, cam: Camera, opt: RasterOptions, geometry_only: bool
) -> tuple[Tensor, Tensor, Tensor, int]:
    """(visible rows [V], their tile rectangles [V,4], radii [N], number of inputs that are not finite).

    A Gaussian whose classic tile rectangle is empty is culled in every profile, so radii > 0 says what is drawn.
    """
    n = len(g)
    finite = finite_rows(g, geometry_only)
    keep = finite if g.visible is None else finite & g.visible
    if not geometry_only:
        keep = keep & (g.opacities >= 0)
    if g.quats is not None:
        norm = torch.linalg.vector_norm(g.quats, dim=-1)
        usable = (norm > 0) & torch.isfinite(norm)
        keep = keep & (usable if g.geom_indices is None else usable[g.geom_indices])
    tz = g.means @ cam.R[2] + cam.tau[2]
    rows = torch.nonzero(keep & (tz > cam.near) & (tz < cam.far)).squeeze(1)

    _, u, c0 = _screen(g.means[rows], _world_covariances(g, rows, opt.scale_modifier), cam, dgr_gradient=False)
    c = _add_low_pass(c0, opt.eps2d)
    det = _determinant(c)
    mid = 0.5 * (c[:, 0] + c[:, 2])
    largest = mid + torch.sqrt((mid * mid - det).clamp(min=LAMBDA_FLOOR))
    radius = torch.ceil(RADIUS_SIGMA * torch.sqrt(largest))
    ok = (det > 0) & torch.isfinite(det) & torch.isfinite(radius) & torch.isfinite(u * u).all(dim=1)
    rect = tile_rectangle(torch.where(ok[:, None], u, 0), torch.where(ok, radius, 0), cam)
    ok &= (rect[:, 2] > rect[:, 0]) & (rect[:, 3] > rect[:, 1])

    rows, rect, radius = rows[ok], rect[ok], radius[ok]
    radii = torch.zeros(n, dtype=torch.int32, device=g.means.device)
    radii[rows] = radius.clamp(1, MAX_RADIUS).to(torch.int32)
    return rows, rect, radii, n - int(finite.sum())


def visible_radii(g: GaussianInputs, cam: Camera, opt: RasterOptions) -> Tensor:
    """Radii [N] int32 from means and covariances alone; 0 = culled. No gradient."""
    return _cull(g, cam, opt, geometry_only=True)[2]


def project(g: GaussianInputs, cam: Camera, opt: RasterOptions, *, dgr_gradient: bool = False) -> Projection:
    """Project the visible Gaussians; differentiable in means, opacities, scales, quats and cov3d.

    Culling is decided first, without gradient, so that a culled or broken Gaussian gets a gradient of exactly zero
    and cannot spoil another one's.
    dgr_gradient  differentiate the clamped Jacobian as the original kernels do, which is not its derivative
    """
    rows, rect, radii, n_invalid = _cull(g, cam, opt, geometry_only=False)
    S = _world_covariances(g, rows, opt.scale_modifier)
    t, u, c0 = _screen(g.means[rows], S, cam, dgr_gradient=dgr_gradient)
    c = _add_low_pass(c0, opt.eps2d)
    det = _determinant(c)
    conic = torch.stack([c[:, 2], -c[:, 1], c[:, 0]], dim=-1) / det[:, None]
    opacity = g.opacities[rows]
    if opt.antialias:
        opacity = opacity * torch.sqrt((_determinant(c0) / det).clamp(min=COMP_FLOOR))
    return Projection(rows, u, c.detach(), conic, opacity, t[:, 2], rect, radii, n_invalid)
