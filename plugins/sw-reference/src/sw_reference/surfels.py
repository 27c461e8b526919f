"""Flat Gaussians (surfels, 2DGS) in pure torch: exact ray-splat intersection, normals, distortion, depth.

A surfel is a Gaussian on a plane: scales [N,2] along the first two columns of its rotation, normal = the third. With
H = [s1 r1, s2 r2, t] (camera frame) and T = K H, rows Tu, Tv, Tw, the plane point (a, b) is seen at the homogeneous
pixel T (a, b, 1). A pixel's ray meets the plane where both (x Tw - Tu) and (y Tw - Tv) vanish: one cross product.
Source: 2D Gaussian Splatting (arXiv 2403.17888).
"""

from __future__ import annotations

import functools
import logging
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from splatwizard_core.api import (
    Camera,
    CapabilityError,
    GaussianInputs,
    GradBuffer,
    RasterOptions,
    RasterStats,
    RenderResult,
)
from sw_reference.compositing import (
    ALPHA_MAX,
    ALPHA_MIN,
    Drawn,
    TileLists,
    box_rectangles,
    draw_batches,
    last_above_half,
    log_cutoff,
    tile_lists,
    transmit,
)
from sw_reference.projection import (
    CLASSIC_TILE,
    MAX_RADIUS,
    RADIUS_SIGMA,
    finite_rows,
    rotation_matrices,
    tile_rectangle,
)
from sw_reference.shading import background_image, splat_colors

LOW_PASS_SIGMA = 0.5**0.5
"""Pixels: a surfel seen edge on is at least a screen Gaussian of this size around its centre."""
MIN_EXTENT = 1e-4
"""Floor under the square of the half extents, px^2."""
DISTORTION_NEAR, DISTORTION_FAR = 0.2, 100.0
"""World units: depth is mapped to 0..1 between them before the distortion compares it."""

log = logging.getLogger(__name__)
_SURFELS_ONLY = ("normals", "distortion")


@dataclass
class SurfelProjection:
    """Visible surfels on the screen, in input order.

    rows        [V] int64, which inputs are visible
    T           [V,3,3] plane coordinates (a, b, 1) -> homogeneous pixels, rows Tu, Tv, Tw
    center      [V,2] middle of the 3-sigma outline, pixels
    normal      [V,3] unit, camera frame, towards the camera
    opacity     [V]
    depth       [V] camera z of the centre: the order
    rect        [V,4] int64: classic 16x16 tiles
    radii       [N] int32, 0 = culled
    n_invalid   how many inputs were culled because a value is not finite
    """

    rows: Tensor
    T: Tensor
    center: Tensor
    normal: Tensor
    opacity: Tensor
    depth: Tensor
    rect: Tensor
    radii: Tensor
    n_invalid: int


def are_surfels(g: GaussianInputs) -> bool:
    """Whether the inputs are flat: two scales each."""
    return g.scales is not None and g.scales.shape[1] == 2


def check_ellipsoids(name: str, opt: RasterOptions) -> None:
    """Raise CapabilityError for maps that only surfels have."""
    asked = [field for field in _SURFELS_ONLY if getattr(opt, field)]
    if asked:
        raise CapabilityError(
            f"rasterizer '{name}' draws {' and '.join(asked)} of surfels only: scales must be [N, 2]",
            missing=frozenset(field.upper() for field in asked),
        )


@functools.cache
def warn_of_low_pass(eps2d: float) -> None:
    """Say, once a process, that surfels are drawn without the low-pass of ellipsoids that was asked for.

    No error: files may ask for it, and are drawn as they were measured.
    """
    log.warning("eps2d = %g has no effect on surfels, which have a low-pass of their own", eps2d)


def _planes(g: GaussianInputs, rows: Tensor, cam: Camera, modifier: float) -> tuple[Tensor, Tensor]:
    """(T [V,3,3], normal [V,3]) of the rows."""
    assert g.scales is not None
    assert g.quats is not None
    at = rows if g.geom_indices is None else g.geom_indices[rows]
    scales = modifier * g.scales[at]
    if g.scale_factors is not None:
        scales = scales * g.scale_factors[rows, None]
    axes = cam.R @ rotation_matrices(g.quats[at])  # columns in the camera frame
    t = g.means[rows] @ cam.R.T + cam.tau
    H = torch.stack([axes[:, :, 0] * scales[:, :1], axes[:, :, 1] * scales[:, 1:], t], dim=2)
    normal = axes[:, :, 2]
    away = (normal * t).sum(dim=1, keepdim=True) > 0
    return cam.K.to(t) @ H, torch.where(away, -normal, normal)


def _outline(T: Tensor, level: Tensor | float) -> tuple[Tensor, Tensor, Tensor]:
    """(centre [V,2], half extents squared [V,2], D [V]) of the picture of the circle of radius sqrt(level).

    D < 0: the circle lies in front of the camera plane and its picture is an ellipse.
    """
    one = torch.ones_like(T[:, 0, 0])
    q = torch.stack([level * one, level * one, -one], dim=1)  # [V,3]
    Tw = T[:, 2]
    D = (q * Tw * Tw).sum(dim=1)
    f = q / torch.where(D == 0, 1, D)[:, None]
    center = (f[:, None] * T[:, :2] * Tw[:, None]).sum(dim=2)
    squared = center * center - (f[:, None] * T[:, :2] * T[:, :2]).sum(dim=2)
    return center, squared, D


@torch.no_grad()
def _cull(
    g: GaussianInputs, cam: Camera, opt: RasterOptions, geometry_only: bool
) -> tuple[Tensor, Tensor, Tensor, int]:
    """(visible rows [V], their tile rectangles [V,4], radii [N], number of inputs that are not finite)."""
    assert g.quats is not None
    finite = finite_rows(g, geometry_only)
    keep = finite if g.visible is None else finite & g.visible
    if not geometry_only:
        keep = keep & (g.opacities >= 0)
    norm = torch.linalg.vector_norm(g.quats, dim=-1)
    usable = (norm > 0) & torch.isfinite(norm)
    keep = keep & (usable if g.geom_indices is None else usable[g.geom_indices])
    tz = g.means @ cam.R[2] + cam.tau[2]
    rows = torch.nonzero(keep & (tz > cam.near) & (tz < cam.far)).squeeze(1)

    T, normal = _planes(g, rows, cam, opt.scale_modifier)
    facing = (normal * (g.means[rows] @ cam.R.T + cam.tau)).sum(dim=1)
    center, squared, D = _outline(T, RADIUS_SIGMA**2)
    extent = torch.sqrt(squared.clamp(min=MIN_EXTENT)).amax(dim=1)
    radius = torch.ceil(extent.clamp(min=RADIUS_SIGMA * LOW_PASS_SIGMA))
    # An edge-on plane and one with a scale of zero are met by no ray (or by all points of one).
    ok = (D != 0) & (facing != 0) & (torch.linalg.det(T) != 0)
    ok &= torch.isfinite(T).flatten(1).all(dim=1) & torch.isfinite(radius) & torch.isfinite(center).all(dim=1)
    rect = tile_rectangle(torch.where(ok[:, None], center, 0), torch.where(ok, radius, 0), cam)
    ok &= (rect[:, 2] > rect[:, 0]) & (rect[:, 3] > rect[:, 1])

    rows, rect, radius = rows[ok], rect[ok], radius[ok]
    radii = torch.zeros(len(g), dtype=torch.int32, device=g.means.device)
    radii[rows] = radius.clamp(1, MAX_RADIUS).to(torch.int32)
    return rows, rect, radii, len(g) - int(finite.sum())


def visible_surfel_radii(g: GaussianInputs, cam: Camera) -> Tensor:
    """Radii [N] int32 from geometry alone; 0 = culled. No gradient."""
    return _cull(g, cam, RasterOptions(), geometry_only=True)[2]


def project_surfels(g: GaussianInputs, cam: Camera, opt: RasterOptions) -> SurfelProjection:
    """Project the visible surfels; differentiable in means, opacities, scales and quats."""
    rows, rect, radii, n_invalid = _cull(g, cam, opt, geometry_only=False)
    T, normal = _planes(g, rows, cam, opt.scale_modifier)
    return SurfelProjection(rows, T, _outline(T, RADIUS_SIGMA**2)[0], normal, g.opacities[rows],
                            T[:, 2, 2], rect, radii, n_invalid)  # fmt: skip


@torch.no_grad()
def _rectangles(p: SurfelProjection, cam: Camera, tile: int, *, classic: bool) -> Tensor:
    """[V,4] tiles that may hold a pixel with alpha >= 1/255: the outline at that level, and the low-pass around it.

    The picture of a plane that reaches behind the camera has no end: such a surfel is tried everywhere.
    """
    if classic:
        assert tile == CLASSIC_TILE
        return p.rect
    level = log_cutoff(p.opacity)
    center, squared, D = _outline(p.T, level.clamp(min=0))
    extent = torch.sqrt(squared.clamp(min=0))
    dot = LOW_PASS_SIGMA * torch.sqrt(level.clamp(min=0))[:, None]
    low = torch.minimum(center - extent, p.center - dot)
    high = torch.maximum(center + extent, p.center + dot)
    ends = ((D < 0) & torch.isfinite(low).all(dim=1) & torch.isfinite(high).all(dim=1))[:, None]
    size = low.new_tensor([cam.width, cam.height])
    low, high = torch.where(ends, low, 0), torch.where(ends, high, size)
    return box_rectangles(low, high, level >= 0, cam.width, cam.height, tile)


def draw_surfels(
    g: GaussianInputs, cam: Camera, opt: RasterOptions, *, tile: int, classic: bool, pass_clamp: bool
) -> RenderResult:
    """Draw one view of surfels; the options are those of the reference rasterizer."""
    if opt.eps2d != RasterOptions.eps2d:
        warn_of_low_pass(opt.eps2d)
    p = project_surfels(g, cam, opt)
    order = torch.argsort(p.depth.detach(), stable=True)  # ties by index: rows ascend
    tile = CLASSIC_TILE if classic else tile
    lists = tile_lists(_rectangles(p, cam, tile, classic=classic)[order], cam.width, cam.height, tile)
    T, grad2d = _watch_center_shift(p, g, cam, opt)
    # Through T, so that the statistic sees the centre's share as well.
    center = p.center if T is p.T else _outline(T, RADIUS_SIGMA**2)[0]
    colors = splat_colors(g, p.rows, cam, opt)
    channels = [colors, p.normal]
    if g.features is not None:
        channels.append(g.features[p.rows])
    num_features = 0 if g.features is None else g.features.shape[1]
    packed = torch.cat([T.flatten(1), center, p.opacity[:, None], *channels], dim=1)[order]
    drawn = _composite(
        packed, lists, cam, pass_clamp=pass_clamp, detached=num_features if opt.features_detach_geometry else 0
    )

    summed, accumulated, inverse, median, _, _, distortion = drawn.state
    assert summed is not None
    num_colors = colors.shape[1]
    alpha = 1 - drawn.T[None]
    depth = {"accumulated": accumulated, "inverse": inverse, "median": median}
    if accumulated is not None:
        depth["expected"] = accumulated / alpha.clamp(min=1e-10)
    return RenderResult(
        image=summed[:num_colors] + drawn.T * background_image(opt, num_colors, cam, g.means),
        radii=p.radii,
        inputs=g,
        alpha=alpha if opt.alpha else None,
        depth={name: found for name in sorted(opt.depth) if (found := depth[name]) is not None},
        normals=summed[num_colors : num_colors + 3] if opt.normals else None,
        distortion=distortion if opt.distortion else None,
        features=summed[num_colors + 3 :] if num_features else None,
        grad2d=grad2d,
        stats=RasterStats(
            n_visible=len(p.rows),
            n_pairs=len(lists.splats),
            n_evaluated=drawn.n_evaluated,
            n_blended=drawn.n_blended,
            n_pixels=cam.width * cam.height,
            n_invalid=p.n_invalid,
        ),
    )


def _watch_center_shift(
    p: SurfelProjection, g: GaussianInputs, cam: Camera, opt: RasterOptions
) -> tuple[Tensor, GradBuffer | None]:
    """(T, buffer): the derivative with respect to a shift of the surfel on the screen, NDC units.

    Adding Tw.z d to Tu.z moves the centre by d pixels and leaves the plane's axes: hence dTu.z Tw.z, times W/2.
    """
    if not opt.grad2d or not torch.is_grad_enabled():
        return p.T, None
    T = p.T if p.T.requires_grad else p.T.detach().requires_grad_()
    T = T.clone()  # its gradient is then that of all uses of it, the centre included
    buffer = GradBuffer()
    to_ndc = T.new_tensor([cam.width / 2, cam.height / 2]) * T.detach()[:, 2, 2, None]

    def store(gradient: Tensor) -> None:
        buffer.set(gradient.new_zeros(len(g), 2).index_copy(0, p.rows, gradient[:, :2, 2] * to_ndc))

    T.register_hook(store)  # type: ignore[no-untyped-call]
    return T, buffer


def _composite(packed: Tensor, lists: TileLists, cam: Camera, *, pass_clamp: bool, detached: int) -> Drawn:
    """Blend; `packed` [V, 12 + D]: T (9), centre (2), opacity, channels (the last `detached` leave the geometry alone).

    The state: channels, sum w z, sum w / z, median z, running sum w m, sum w m^2, distortion.
    """
    num_channels = packed.shape[1] - 12
    attached = num_channels - detached

    def blend(
        packed: Tensor, ids: Tensor, valid: Tensor, centres: Tensor, T: Tensor, done: Tensor,
        total: Tensor, accumulated: Tensor, inverse: Tensor, median: Tensor,
        first: Tensor, second: Tensor, distortion: Tensor,
    ) -> tuple[Any, ...]:  # fmt: skip
        rows = packed.index_select(0, ids.reshape(-1)).reshape(*ids.shape, packed.shape[1])  # [B,L,12+D]
        alpha, z = _falloff(rows, centres, valid, cam, pass_clamp=pass_clamp)
        passed, _, weight, T_after, done_after = transmit(alpha, T, done)
        channels = rows[..., 12:]
        sums = [torch.bmm(weight, channels[..., :attached])]
        if detached:
            sums.append(torch.bmm(weight.detach(), channels[..., attached:]))

        m = DISTORTION_FAR / (DISTORTION_FAR - DISTORTION_NEAR) * (1 - DISTORTION_NEAR / z)
        wm, wmm = weight * m, weight * m * m
        in_front = 1 - passed[..., :-1]  # sum of the weights before each splat
        sum_m = first[..., None] + torch.cumsum(wm, dim=-1) - wm
        sum_mm = second[..., None] + torch.cumsum(wmm, dim=-1) - wmm
        distortion = distortion + (weight * (m * m * in_front + sum_mm - 2 * m * sum_m)).sum(dim=-1)

        blended = weight > 0
        if ids.shape[1]:
            last = last_above_half(blended, passed[..., :-1])
            at = (last - 1).clamp(min=0)[..., None]
            median = torch.where(last > 0, z.gather(-1, at).squeeze(-1), median)
        return (
            T_after, done_after, blended.sum(), total + torch.cat(sums, dim=-1),
            accumulated + (weight * z).sum(dim=-1), inverse + (weight / z).sum(dim=-1), median,
            first + wm.sum(dim=-1), second + wmm.sum(dim=-1), distortion,
        )  # fmt: skip

    return draw_batches(blend, [num_channels, 0, 0, 0, 0, 0, 0], packed, lists, cam.width, cam.height)


def _falloff(rows: Tensor, centres: Tensor, valid: Tensor, cam: Camera, *, pass_clamp: bool) -> tuple[Tensor, Tensor]:
    """(alpha, z), each [B,P,L], of rows [B,L,12+D] at pixels [B,P,2]; alpha is 0 (and z 1) where skipped."""
    Tu, Tv, Tw = (rows[:, None, :, i : i + 3] for i in (0, 3, 6))  # [B,1,L,3]
    x, y = centres[:, :, None, :1], centres[:, :, None, 1:]  # [B,P,1,1]
    p = torch.linalg.cross(x * Tw - Tu, y * Tw - Tv)  # [B,P,L,3]
    with torch.no_grad():
        z = (p * Tw).sum(dim=-1) / p[..., 2]
        met = valid[:, None] & (p[..., 2] != 0) & (z >= cam.near) & (z <= cam.far)  # no ray, behind: skipped
    s = p[..., :2] / torch.where(met, p[..., 2], 1)[..., None]
    z = torch.where(met, (s * Tw[..., :2]).sum(dim=-1) + Tw[..., 2], 1)
    on_plane = (s * s).sum(dim=-1)
    d = rows[:, None, :, 9:11] - centres[:, :, None]
    on_screen = (d * d).sum(dim=-1) / LOW_PASS_SIGMA**2
    rho = torch.where(on_plane <= on_screen, on_plane, on_screen)
    raw = rows[:, None, :, 11] * torch.exp(-0.5 * rho)
    alpha = raw.clamp(max=ALPHA_MAX)
    if pass_clamp:
        alpha = raw + (alpha - raw).detach()
    return torch.where(met & (alpha >= ALPHA_MIN), alpha, 0), z
