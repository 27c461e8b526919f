"""Pictures and gradients that can be worked out by hand (specification: rasterizers, closed forms)."""

from __future__ import annotations

import math

import torch

from splatwizard_core.api import SH, Rasterizer, RasterOptions
from sw_reference.testing.facts import check, close, draw
from sw_reference.testing.raster_scenes import front_camera, permute_inputs, splats

VARIANCE = (64 * 0.2 / 4) ** 2 + 0.3
"""Of the standard splat (scale 0.2 at depth 4, focal length 64) on the screen, px^2."""
CENTRE_ALPHA = 0.8 * math.exp(-0.25 / VARIANCE)
"""At the four central pixels: d = (0.5, 0.5), opacity 0.8."""


@check()
def single_splat_has_its_closed_form(r: Rasterizer, device: str) -> None:
    g = splats([[0, 0, 4]], opacities=[0.8])
    background = torch.tensor([0.1, 0.5, 0.9], device=device)
    result = draw(r, device, g, front_camera(), RasterOptions(background=background))
    assert g.colors is not None
    expected = CENTRE_ALPHA * g.colors[0] + (1 - CENTRE_ALPHA) * background.cpu()
    assert abs(CENTRE_ALPHA - 0.78124794) < 1e-8
    for row, column in ((31, 31), (31, 32), (32, 31), (32, 32)):
        close(result.image[:, row, column], expected)
    assert result.radii.tolist() == [10]
    assert result.radii.dtype == torch.int32
    assert result.visible.tolist() == [True]
    assert result.image.shape == (3, 64, 64)
    close(result.image[:, 0, 0], background)


@check("ALPHA_MAP")
def alpha_map_is_the_splat_inside_its_exact_support(r: Rasterizer, device: str) -> None:
    result = draw(r, device, splats([[0, 0, 4]], opacities=[0.3]), front_camera(), RasterOptions(alpha=True))
    ys, xs = torch.meshgrid(torch.arange(64) + 0.5, torch.arange(64) + 0.5, indexing="ij")
    value = 0.3 * torch.exp(-0.5 * ((xs - 32) ** 2 + (ys - 32) ** 2) / VARIANCE)
    assert result.alpha is not None
    close(result.alpha[0], torch.where(value >= 1 / 255, value, 0))


@check()
def what_was_not_asked_for_is_absent(r: Rasterizer, device: str) -> None:
    result = draw(r, device, splats([[0, 0, 4]], opacities=[0.8]), front_camera(), RasterOptions())
    assert (result.alpha, result.features, result.normals, result.distortion) == (None,) * 4
    assert (result.grad2d, result.absgrad2d, result.fisher) == (None,) * 3
    assert result.depth == {}
    assert result.scores == {}


@check("BACKWARD")
def opacity_gradient_at_one_pixel(r: Rasterizer, device: str) -> None:
    g = splats([[0, 0, 4]], opacities=[0.8])
    g.opacities.requires_grad_()
    background = torch.tensor([0.1, 0.5, 0.9], device=device)
    image = draw(r, device, g, front_camera(), RasterOptions(background=background)).image
    weights = torch.tensor([1.0, -2.0, 0.5], device=device)
    (gradient,) = torch.autograd.grad((image[:, 32, 32] * weights).sum(), g.opacities)
    assert g.colors is not None
    close(gradient, math.exp(-0.25 / VARIANCE) * ((g.colors[0] - background.cpu()) * weights.cpu()).sum())


@check("ANTIALIAS", "ALPHA_MAP")
def antialias_factor_and_its_floor(r: Rasterizer, device: str) -> None:
    options = RasterOptions(antialias=True, alpha=True)
    cam = front_camera(cx=32.5, cy=32.5)  # the splats sit on a pixel centre
    large = draw(r, device, splats([[0, 0, 4]], opacities=[0.8]), cam, options).alpha
    assert large is not None
    close(large[0, 32, 32], 0.8 * 10.24 / 10.54)
    tiny = draw(r, device, splats([[0, 0, 4]], opacities=[1.0], scales=[1e-7]), cam, options).alpha
    assert tiny is not None
    close(tiny[0, 32, 32], 0.005)


@check()
def nearer_splat_is_in_front_whatever_the_input_order(r: Rasterizer, device: str) -> None:
    g = splats([[0, 0, 4], [0, 0, 5]], opacities=[0.6, 0.8])
    assert g.colors is not None
    a1 = 0.6 * math.exp(-0.25 / VARIANCE)
    a2 = 0.8 * math.exp(-0.25 / ((64 * 0.2 / 5) ** 2 + 0.3))
    image = draw(r, device, g, front_camera(), RasterOptions()).image
    close(image[:, 32, 32], a1 * g.colors[0] + (1 - a1) * a2 * g.colors[1])
    swapped = draw(r, device, permute_inputs(g, torch.tensor([1, 0])), front_camera(), RasterOptions()).image
    assert torch.equal(image, swapped)
    g.means = g.means.flip(0)
    other = draw(r, device, g, front_camera(), RasterOptions()).image
    a1, a2 = a2 * 0.6 / 0.8, a1 * 0.8 / 0.6
    close(other[:, 32, 32], a2 * g.colors[1] + (1 - a2) * a1 * g.colors[0])


@check("ALPHA_MAP")
def alpha_is_clamped_at_099(r: Rasterizer, device: str) -> None:
    cam = front_camera(cx=32.5, cy=32.5)
    for opacity in (1.0, 1.7):
        alpha = draw(r, device, splats([[0, 0, 4]], opacities=[opacity]), cam, RasterOptions(alpha=True)).alpha
        assert alpha is not None
        close(alpha[0, 32, 32], 0.99)


@check("ALPHA_MAP")
def a_pixel_stops_before_the_splat_that_would_exhaust_it(r: Rasterizer, device: str) -> None:
    """0.11^4 = 1.46e-4 is left; a fifth would leave 1.6e-5; the faint sixth would fit but comes too late."""
    g = splats([[0, 0, 4 + 0.1 * i] for i in range(6)], opacities=[0.89] * 5 + [0.05])
    alpha = draw(r, device, g, front_camera(cx=32.5, cy=32.5), RasterOptions(alpha=True)).alpha
    assert alpha is not None
    close(1 - alpha[0, 32, 32], 0.11**4, atol=2e-7)
    without = permute_inputs(g, torch.tensor([0, 1, 2, 3, 5]))
    alpha = draw(r, device, without, front_camera(cx=32.5, cy=32.5), RasterOptions(alpha=True)).alpha
    assert alpha is not None
    close(1 - alpha[0, 32, 32], 0.11**4 * 0.95, atol=2e-7)


@check("BACKWARD")
def quaternions_of_any_norm_and_sign_rotate_alike(r: Rasterizer, device: str) -> None:
    images, gradients = [], []
    for factor in (1.0, -1.0, 3.0):
        g = splats([[0.2, 0.1, 4]], opacities=[0.8])
        g.scales = torch.tensor([[0.4, 0.1, 0.2]])
        g.quats = (factor * torch.tensor([[0.7, 0.3, -0.2, 0.5]])).requires_grad_()
        image = draw(r, device, g, front_camera(), RasterOptions()).image
        pattern = torch.sin(torch.arange(image.numel(), device=device).reshape(image.shape) * 0.01)
        (gradient,) = torch.autograd.grad((image * pattern).sum(), g.quats)
        images.append(image)
        gradients.append(gradient)
    close(images[1], images[0])
    close(images[2], images[0])
    close(gradients[1], -gradients[0], atol=1e-4, rtol=1e-3)
    close(gradients[2], gradients[0] / 3, atol=1e-4, rtol=1e-3)


@check("DEPTH_INVERSE", "DEPTH_ACCUM", "DEPTH_EXPECTED", "DEPTH_MEDIAN", "ALPHA_MAP")
def depth_modes_of_one_splat(r: Rasterizer, device: str) -> None:
    modes = frozenset({"inverse", "accumulated", "expected", "median"})
    options = RasterOptions(depth=modes, alpha=True)
    result = draw(r, device, splats([[0, 0, 4]], opacities=[0.8]), front_camera(), options)
    assert result.alpha is not None
    assert set(result.depth) == modes
    drawn = result.alpha > 0
    assert 0 < int(drawn.sum()) < 64 * 64
    close(result.depth["inverse"], result.alpha / 4)
    close(result.depth["accumulated"], result.alpha * 4)
    close(result.depth["expected"], torch.where(drawn, 4.0, 0.0))
    close(result.depth["median"], torch.where(drawn, 4.0, 0.0))


@check("DEPTH_MEDIAN")
def median_depth_is_the_last_splat_that_more_than_half_the_light_reaches(r: Rasterizer, device: str) -> None:
    g = splats([[0, 0, 4], [0, 0, 5], [0, 0, 6]], opacities=[0.4, 0.4, 0.4])
    median = draw(r, device, g, front_camera(), RasterOptions(depth=frozenset({"median"}))).depth["median"]
    close(median[0, 32, 32], 5.0)  # T before the third is 0.36


@check("EXTRA_FEATURES")
def features_are_composited_like_colours_without_background(r: Rasterizer, device: str) -> None:
    g = splats([[0, 0, 4], [0.3, 0.1, 5]], opacities=[0.6, 0.8])
    assert g.colors is not None
    plain = draw(r, device, g, front_camera(), RasterOptions()).image
    g.features = torch.cat([g.colors, g.colors.flip(1)], dim=1)
    result = draw(r, device, g, front_camera(), RasterOptions(background=torch.ones(3, device=device)))
    assert result.features is not None
    assert result.features.shape == (6, 64, 64)
    close(result.features[:3], plain)
    close(result.features[3:], plain.flip(0))


@check("EXTRA_FEATURES", "BACKWARD")
def detached_features_leave_geometry_alone(r: Rasterizer, device: str) -> None:
    g = splats([[0.1, 0, 4], [0.3, 0.1, 5]], opacities=[0.6, 0.8])
    g.features = torch.tensor([[1.0], [2.0]], requires_grad=True)
    g.means.requires_grad_()
    options = RasterOptions(features_detach_geometry=True)
    features = draw(r, device, g, front_camera(), options).features
    assert features is not None
    to_features, to_means = torch.autograd.grad(features.square().sum(), [g.features, g.means], allow_unused=True)
    assert float(to_features.abs().min()) > 0
    assert to_means is None or float(to_means.abs().max()) == 0


@check("COLORS_ND")
def any_number_of_colour_channels(r: Rasterizer, device: str) -> None:
    for channels in (1, 2, 7):
        colors = torch.rand(2, channels, generator=torch.Generator().manual_seed(channels))
        g = splats([[0, 0, 4], [0.3, 0.1, 5]], opacities=[0.6, 0.8], colors=colors)
        image = draw(r, device, g, front_camera(), RasterOptions()).image
        assert image.shape == (channels, 64, 64)
        for i in range(channels):
            g.colors = colors[:, i : i + 1].repeat(1, 3)
            close(draw(r, device, g, front_camera(), RasterOptions()).image[0], image[i])


@check()
def negative_sh_colours_are_clamped_at_zero(r: Rasterizer, device: str) -> None:
    g = splats([[0, 0, 4]], opacities=[0.8])
    g.colors = None
    g.sh = SH.from_rgb(torch.tensor([[-0.5, 0.25, 1.5]]))
    image = draw(r, device, g, front_camera(), RasterOptions()).image
    close(image[:, 32, 32], CENTRE_ALPHA * torch.tensor([0.0, 0.25, 1.5]))


@check("NO_COLOR_CLAMP")
def unclamped_sh_colours_stay_negative(r: Rasterizer, device: str) -> None:
    g = splats([[0, 0, 4]], opacities=[0.8])
    g.colors = None
    g.sh = SH.from_rgb(torch.tensor([[-0.5, 0.25, 1.5]]))
    image = draw(r, device, g, front_camera(), RasterOptions(clamp_color=False)).image
    close(image[:, 32, 32], CENTRE_ALPHA * torch.tensor([-0.5, 0.25, 1.5]))


@check()
def background_may_be_a_picture(r: Rasterizer, device: str) -> None:
    picture = torch.rand(3, 64, 64, generator=torch.Generator().manual_seed(1))
    g = splats([[0, 0, 4]], opacities=[0.8])
    with_it = draw(r, device, g, front_camera(), RasterOptions(background=picture.to(device))).image
    without = draw(r, device, g, front_camera(), RasterOptions()).image
    white = draw(r, device, g, front_camera(), RasterOptions(background=torch.ones(3, device=device))).image
    close(with_it, without.cpu() + (white - without).cpu() * picture)


@check("BACKWARD")
def scale_modifier_multiplies_scales_and_their_gradient(r: Rasterizer, device: str) -> None:
    g = splats([[0.1, 0, 4]], opacities=[0.8])
    assert g.scales is not None
    base = g.scales
    results = []
    for modifier, scales in ((1.5, base.clone()), (1.0, 1.5 * base)):
        g.scales = scales.requires_grad_()
        image = draw(r, device, g, front_camera(), RasterOptions(scale_modifier=modifier)).image
        (gradient,) = torch.autograd.grad(image.square().sum(), g.scales)
        results.append((image, gradient / modifier))
    close(results[0][0], results[1][0])
    close(results[0][1], results[1][1], atol=1e-3, rtol=1e-4)


@check("BACKWARD")
def screen_gradient_is_in_ndc_units(r: Rasterizer, device: str) -> None:
    """One splat, L = one pixel: dL/du = -alpha (col - bg).g K d, times half the image size."""
    g = splats([[0, 0, 4]], opacities=[0.8])
    g.means.requires_grad_()
    cam = front_camera(64, 32)
    result = draw(r, device, g, cam, RasterOptions(grad2d=True))
    torch.autograd.backward(result.image[:, 20, 30].sum())
    assert result.grad2d is not None
    assert g.colors is not None
    dx, dy = 32 - 30.5, 16 - 20.5
    alpha = 0.8 * math.exp(-0.5 * (dx * dx + dy * dy) / VARIANCE)
    slope = -alpha * float(g.colors[0].sum()) / VARIANCE
    close(result.grad2d.value, torch.tensor([[slope * dx * 32, slope * dy * 16]]))


@check("BACKWARD", "ABSGRAD")
def absolute_gradient_is_the_sum_over_pixels(r: Rasterizer, device: str) -> None:
    """Against the plain gradient of each pixel's loss alone."""
    g = splats([[0, 0, 4], [0.4, 0.3, 5], [-0.3, 0.2, 6]], opacities=[0.6, 0.8, 0.7])
    g.means.requires_grad_()
    cam = front_camera(9, 7)
    options = RasterOptions(grad2d=True, absgrad=True)
    weights = torch.randn(3, 7, 9, generator=torch.Generator().manual_seed(2)).to(device)
    whole = draw(r, device, g, cam, options)
    torch.autograd.backward((whole.image * weights).sum())
    signed, absolute = torch.zeros(3, 2), torch.zeros(3, 2)
    for row in range(7):
        for column in range(9):
            result = draw(r, device, g, cam, options)
            torch.autograd.backward((result.image * weights)[:, row, column].sum())
            assert result.grad2d is not None
            signed += result.grad2d.value.cpu()
            absolute += result.grad2d.value.abs().cpu()
    assert whole.grad2d is not None
    assert whole.absgrad2d is not None
    close(whole.grad2d.value, signed, atol=1e-4, rtol=1e-4)
    close(whole.absgrad2d.value, absolute, atol=1e-4, rtol=1e-4)
