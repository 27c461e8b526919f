"""Facts about surfels: closed forms of one or two flat Gaussians, and what holds for ellipsoids as well."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from splatwizard_core.api import (
    AccumOutput,
    Camera,
    GaussianInputs,
    Rasterizer,
    RasterizerInfo,
    RasterOptions,
    RenderResult,
)
from sw_reference.testing import raster_closed_forms, raster_robustness
from sw_reference.testing.facts import CheckFunction, check, close, draw
from sw_reference.testing.raster_scenes import front_camera, splats

DEPTHS = frozenset({"accumulated", "expected", "inverse", "median"})
EVERYTHING = RasterOptions(depth=DEPTHS, normals=True, distortion=True, alpha=True)
NEEDS = ("SURFEL", "NORMALS", "DISTORTION", "DEPTH_ACCUM", "DEPTH_EXPECTED", "DEPTH_INVERSE", "DEPTH_MEDIAN",
         "ALPHA_MAP")  # fmt: skip


class _Flattened:
    """A rasterizer that drops the third scale of what it is given: facts about ellipsoids become such of surfels."""

    def __init__(self, inner: Rasterizer) -> None:
        self.inner = inner
        self.info: RasterizerInfo = inner.info

    def render(self, g: GaussianInputs, cam: Camera, opt: RasterOptions) -> RenderResult:
        return self.inner.render(_flat(g), cam, opt)

    def visible_filter(self, g: GaussianInputs, cam: Camera) -> Tensor:
        return self.inner.visible_filter(_flat(g), cam)

    def accumulate(self, g: GaussianInputs, cams: Iterable[Camera], opt: RasterOptions) -> AccumOutput:
        return self.inner.accumulate(_flat(g), cams, opt)


def _flat(g: GaussianInputs) -> GaussianInputs:
    assert g.scales is not None
    return replace(g, scales=g.scales[:, :2])


_SHARED: tuple[tuple[CheckFunction, Sequence[str]], ...] = (
    (raster_robustness.permuting_gaussians_changes_nothing, ["BACKWARD"]),
    (raster_robustness.moving_world_and_camera_together_changes_nothing, []),
    (raster_robustness.doubling_the_resolution_keeps_the_picture, []),
    (raster_robustness.gaussians_that_cannot_be_seen_change_nothing, ["BACKWARD"]),
    (raster_robustness.crops_equal_the_cropped_picture, []),
    (raster_robustness.visible_filter_gives_the_radii_of_a_render, ["VISIBLE_FILTER"]),
    (raster_robustness.visible_mask_leaves_gaussians_out, []),
    (raster_robustness.near_plane_is_exclusive, []),
    (raster_robustness.sizes_that_are_no_multiple_of_a_tile, ["BACKWARD"]),
    (raster_robustness.nothing_to_draw_gives_the_background, ["BACKWARD"]),
    (raster_robustness.broken_gaussians_are_culled_and_harm_no_other, ["BACKWARD"]),
    (raster_robustness.equal_depths_are_drawn_in_index_order, []),
    (raster_robustness.long_lists_in_one_tile, ["BACKWARD"]),
    (raster_closed_forms.background_may_be_a_picture, []),
    (raster_closed_forms.alpha_is_clamped_at_099, ["ALPHA_MAP"]),
    (raster_closed_forms.a_pixel_stops_before_the_splat_that_would_exhaust_it, ["ALPHA_MAP"]),
    (raster_closed_forms.quaternions_of_any_norm_and_sign_rotate_alike, ["BACKWARD"]),
    (raster_closed_forms.scale_modifier_multiplies_scales_and_their_gradient, ["BACKWARD"]),
    (raster_closed_forms.depth_modes_of_one_splat, NEEDS[3:]),
    (raster_closed_forms.median_depth_is_the_last_splat_that_more_than_half_the_light_reaches, ["DEPTH_MEDIAN"]),
)


def _share() -> None:
    for function, needs in _SHARED:

        def flattened(r: Rasterizer, device: str, function: CheckFunction = function) -> None:
            function(_Flattened(r), device)

        flattened.__name__ = f"surfels_{function.__name__}"
        check("SURFEL", *needs)(flattened)


_share()


def surfels(means: list[list[float]], *, opacities: list[float], scales: list[float] | None = None) -> GaussianInputs:
    """Discs that face the camera of `front_camera`."""
    return _flat(splats(means, opacities=opacities, scales=scales))


def _tilted(angle: float, scale: float = 0.5) -> GaussianInputs:
    """One disc at depth 4, turned about the y axis by `angle`, radians."""
    g = surfels([[0, 0, 4]], opacities=[0.8], scales=[scale])
    g.quats = torch.tensor([[math.cos(angle / 2), 0, math.sin(angle / 2), 0]])
    return g


def _offsets(size: int = 64) -> tuple[Tensor, Tensor]:
    """Pixel centres minus the image centre (dx, dy), each [H,W]."""
    ys, xs = torch.meshgrid(torch.arange(size) + 0.5, torch.arange(size) + 0.5, indexing="ij")
    return xs - size / 2, ys - size / 2


@check(*NEEDS)
def disc_that_faces_the_camera(r: Rasterizer, device: str) -> None:
    """rho at an offset of d pixels is (4 d / (64 0.2))^2, depth 4 and normal (0, 0, -1) wherever it is drawn."""
    result = draw(r, device, surfels([[0, 0, 4]], opacities=[0.8]), front_camera(), EVERYTHING)
    dx, dy = _offsets()
    rho = (dx * dx + dy * dy) * (4 / (64 * 0.2)) ** 2
    alpha = 0.8 * torch.exp(-0.5 * rho)
    alpha = torch.where(alpha >= 1 / 255, alpha, 0)
    assert result.alpha is not None
    assert result.normals is not None
    assert result.distortion is not None
    assert result.radii.tolist() == [10]  # ceil(3 * 3.2)
    close(result.alpha[0], alpha)
    drawn = result.alpha > 0
    close(result.depth["expected"], torch.where(drawn, 4.0, 0.0))
    close(result.depth["median"], torch.where(drawn, 4.0, 0.0))
    close(result.depth["inverse"], result.alpha / 4)
    close(result.normals, torch.tensor([0.0, 0, -1])[:, None, None] * alpha)
    assert float(result.distortion.abs().max()) < 1e-6


@check(*NEEDS)
def tilted_disc_is_met_where_the_ray_meets_its_plane(r: Rasterizer, device: str) -> None:
    """Plane through (0, 0, 4) with normal (-sin, 0, -cos): the ray (x, y, 1) meets it at z = 4 cos / (x sin + cos).

    The low-pass lies around the middle between the pictures of the ends of the tilted axis, 3 sigma from the centre.
    """
    angle = 0.9
    result = draw(r, device, _tilted(angle), front_camera(), EVERYTHING)
    dx, dy = _offsets()
    x, y = dx / 64, dy / 64
    z = 4 * math.cos(angle) / (x * math.sin(angle) + math.cos(angle))
    along = (x * z * math.cos(angle) - (z - 4) * math.sin(angle)) / 0.5
    across = y * z / 0.5
    ends = [64 * a * math.cos(angle) / (4 - a * math.sin(angle)) for a in (1.5, -1.5)]
    low_pass = 2 * ((dx - sum(ends) / 2) ** 2 + dy * dy)
    alpha = 0.8 * torch.exp(-0.5 * torch.minimum(along * along + across * across, low_pass))
    drawn = (z > 0.2) & (alpha > 1 / 250)
    assert result.alpha is not None
    assert result.normals is not None
    assert int(drawn.sum()) > 200
    close(result.alpha.cpu()[0][drawn], alpha[drawn], atol=1e-5)
    close(result.depth["expected"].cpu()[0][drawn], z[drawn], atol=1e-4)
    normal = torch.tensor([-math.sin(angle), 0, -math.cos(angle)])
    close(result.normals.cpu()[:, drawn], normal[:, None] * alpha[drawn], atol=1e-5)


@check("SURFEL", "NORMALS", "ALPHA_MAP")
def normals_face_the_camera_from_either_side(r: Rasterizer, device: str) -> None:
    for angle in (0.5, 0.5 + math.pi):
        result = draw(r, device, _tilted(angle), front_camera(), EVERYTHING)
        assert result.normals is not None
        assert result.alpha is not None
        expected = torch.tensor([-math.sin(0.5), 0, -math.cos(0.5)])[:, None, None] * result.alpha.cpu()
        close(result.normals, expected)


@check("SURFEL", "ALPHA_MAP")
def a_tiny_surfel_is_a_dot_of_the_low_pass(r: Rasterizer, device: str) -> None:
    """alpha = o exp(-d^2), a screen Gaussian of variance 1/2, whatever its orientation."""
    for scale in (1e-3, 1e-6):
        for angle in (0.0, 1.2):
            g = _tilted(angle, scale)
            result = draw(r, device, g, front_camera(), RasterOptions(alpha=True))
            dx, dy = _offsets()
            alpha = 0.8 * torch.exp(-(dx * dx + dy * dy))
            assert result.alpha is not None
            close(result.alpha[0], torch.where(alpha >= 1 / 255, alpha, 0), atol=1e-4)
            assert result.radii.tolist() == [3]  # ceil(3 sqrt(1/2))


@check("SURFEL", "DISTORTION", "ALPHA_MAP")
def distortion_of_two_discs(r: Rasterizer, device: str) -> None:
    """w1 w2 (m1 - m2)^2 with m = far/(far - near) (1 - near/z); swapping the inputs changes nothing."""
    g = surfels([[0, 0, 2], [0, 0, 20]], opacities=[0.6, 0.8], scales=[1.0, 10.0])
    result = draw(r, device, g, front_camera(), EVERYTHING)
    dx, dy = _offsets()
    gaussian = torch.exp(-0.5 * (dx * dx + dy * dy) / 32**2)  # both 32 px on the screen
    first = 0.6 * gaussian
    second = (1 - first) * 0.8 * gaussian
    m1, m2 = (100 / 99.8 * (1 - 0.2 / z) for z in (2.0, 20.0))
    assert result.distortion is not None
    close(result.distortion[0], first * second * (m1 - m2) ** 2, atol=1e-7, rtol=1e-3)


@check("SURFEL", "BACKWARD")
def edge_on_and_scaleless_surfels_are_culled(r: Rasterizer, device: str) -> None:
    """The camera lies in the plane; a plane of width zero is met by no ray. Others are not touched by them."""
    half = math.sqrt(0.5)
    for quats, scales in (([half, 0, half, 0], [0.3, 0.3]), ([1.0, 0, 0, 0], [0.0, 0.3]), ([1.0, 0, 0, 0], [0.0, 0.0])):
        g = surfels([[0, 0, 4], [0.2, 0.1, 5]], opacities=[0.8, 0.7])
        assert g.scales is not None
        assert g.quats is not None
        alone = draw(r, device, surfels([[0.2, 0.1, 5]], opacities=[0.7]), front_camera(), EVERYTHING)
        g.colors = torch.cat([torch.ones(1, 3), _first_color(1)])
        g.scales = torch.cat([torch.tensor([scales]), g.scales[1:]]).requires_grad_()
        g.quats = torch.cat([torch.tensor([quats]), g.quats[1:]])
        result = draw(r, device, g, front_camera(), EVERYTHING)
        # 2 half^2 - 1 need not be 0 in float32: what is left of such a surfel is its low-pass, or nothing.
        assert bool(torch.isfinite(result.image).all())
        if scales[0] == 0:
            assert result.visible.tolist() == [False, True]
            close(result.image, alone.image.cpu())
        torch.autograd.backward(result.image.sum())
        assert g.scales.grad is not None
        assert bool(torch.isfinite(g.scales.grad).all())


def _first_color(n: int) -> Tensor:
    colors = splats([[0, 0, 4]] * n, opacities=[1.0] * n).colors
    assert colors is not None
    return colors


@check("SURFEL", "BACKWARD", "NORMALS", "DISTORTION")
def extreme_surfels_stay_finite(r: Rasterizer, device: str) -> None:
    for scale, opacity in ((1e-20, 0.8), (1e6, 0.8), (0.2, 0.0), (0.2, 1.0), (0.2, 3.0)):
        for angle in (0.0, 0.7, math.pi / 2 - 1e-4):
            g = surfels([[0.1, 0, 4], [0.3, 0.1, 5]], opacities=[opacity, 0.8], scales=[scale, 0.2])
            assert g.quats is not None
            g.quats = g.quats.clone()
            g.quats[0] = torch.tensor([math.cos(angle / 2), 0, math.sin(angle / 2), 0])
            leaves = [g.means, g.scales, g.quats, g.opacities]
            for x in leaves:
                assert x is not None
                x.requires_grad_()
            result = draw(r, device, g, front_camera(), EVERYTHING)
            assert result.normals is not None
            assert result.distortion is not None
            maps = [result.image, result.normals, result.distortion]
            assert all(bool(torch.isfinite(x).all()) for x in maps), (scale, opacity, angle)
            torch.autograd.backward(sum(x.sum() for x in maps))  # type: ignore[arg-type]
            for x in leaves:
                assert x is not None
                assert x.grad is not None
                # The square of 1e-20 is close to the smallest float32: only the other one's gradient must be sound.
                assert bool(torch.isfinite(x.grad[scale < 1e-10 :]).all()), (scale, opacity, angle)
    huge = draw(r, device, surfels([[0, 0, 4]], opacities=[0.8], scales=[1e4]), front_camera(), EVERYTHING)
    close(huge.image, 0.8 * _first_color(1)[0][:, None, None].expand(3, 64, 64), atol=1e-4)


@check("SURFEL", "BACKWARD")
def a_shift_on_the_screen_is_the_statistic(r: Rasterizer, device: str) -> None:
    """A disc that faces the camera: dL/du of its centre at constant depth is tz dL/dx / fx; in NDC times W/2."""
    g = surfels([[0.1, 0.05, 4]], opacities=[0.8], scales=[0.6])
    g.means.requires_grad_()
    result = draw(r, device, g, front_camera(64, 32), RasterOptions(grad2d=True))
    torch.autograd.backward(result.image[:, 20, 30].sum())
    assert g.means.grad is not None
    assert result.grad2d is not None
    close(result.grad2d.value, g.means.grad[:, :2] * 4 / 64 * torch.tensor([32.0, 16.0]), atol=1e-6, rtol=1e-4)
