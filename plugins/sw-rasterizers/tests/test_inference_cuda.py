"""The approximate rasterizers on a GPU: close to the exact one, on every size, with every input it takes."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from sw_reference.testing.raster_scenes import RasterCase, cast_inputs, draw_scene, front_camera, splats

from splatwizard_core.api import SH, CapabilityError, ConfigError, RasterOptions
from splatwizard_core.tooling import NegotiatedRasterizer, load_plugins
from sw_rasterizers.inference import FlashRasterizer, TensorCoreRasterizer
from sw_rasterizers.native import unavailable_on_cuda
from sw_rasterizers.standard import StandardRasterizer

pytestmark = [
    pytest.mark.cuda,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU"),
    pytest.mark.skipif(unavailable_on_cuda() is not None, reason=str(unavailable_on_cuda())),
]
BOTH = pytest.mark.parametrize("kind", [FlashRasterizer, TensorCoreRasterizer], ids=lambda k: k.info.name)
MANY = RasterCase("many", n=3000, width=203, height=150, spread=2.0, scale=(0.01, 0.25), degree=3)
"""Fills 13 x 10 tiles, the last ones partial, with lists longer than a stage of the kernels."""


def on_gpu(case, seed=3):
    g, cam = draw_scene(case, seed, torch.float32)
    return cast_inputs(g, torch.float32, "cuda"), cam


def split(g):
    sh = g.sh.dense
    return replace(g, sh=SH(dc=sh[:, :1].clone(), rest=sh[:, 1:].clone(), active_degree=g.sh.active_degree))


@pytest.fixture(autouse=True)
def _no_gradients():
    with torch.no_grad():
        yield


@BOTH
@pytest.mark.parametrize(
    ("options", "changes"),
    [
        (RasterOptions(alpha=True), {}),
        (RasterOptions(alpha=True, background=torch.rand(3), antialias=True, scale_modifier=1.4, eps2d=0.1), {}),
        (RasterOptions(background=torch.rand(3, 150, 203), profile="dgr-exact", clamp_color=False), {}),
        (RasterOptions(), {"color": "colors", "geometry": "cov3d"}),
        (RasterOptions(), {"degree": 3, "active_degree": 1}),
        (RasterOptions(alpha=True), {"n": 40, "scale": (0.5, 1.5)}),
        (RasterOptions(alpha=True), {"n": 20_000, "scale": (0.002, 0.03)}),
        (RasterOptions(alpha=True), {"width": 7, "height": 3}),
        (RasterOptions(alpha=True), {"width": 33, "height": 1}),
    ],
    ids=["plain", "background", "dgr-exact", "cov3d", "bands", "large", "small", "7x3", "33x1"],
)
def test_images_are_close_to_the_exact_ones(kind, options, changes):
    g, cam = on_gpu(replace(MANY, **changes))
    g.opacities[:50] = 1.0  # the clamp of alpha is active somewhere
    for inputs in (g, split(g)) if g.sh is not None else (g,):
        exact = StandardRasterizer().render(inputs, cam, options)
        seen = kind().render(inputs, cam, options)
        assert seen.image.shape == exact.image.shape
        assert torch.equal(seen.radii, exact.radii)
        pairs = [(seen.image, exact.image)] + ([(seen.alpha, exact.alpha)] if options.alpha else [])
        for actual, expected in pairs:
            error = (actual - expected).double()
            assert -10 * math.log10(float(error.square().mean()) + 1e-20) >= 50
            assert float(error.abs().mean()) <= 5e-4
            # A splat that would finish the pixel may weigh 0.99 of a T of up to 0.01, and colours reach 2 or so.
            assert float(error.abs().max()) <= 0.03
        levels = kind().render(inputs, cam, replace(options, alpha=False, dtype_out="uint8")).image
        assert levels.dtype == torch.uint8
        off = (levels.float() - torch.round(255 * exact.image.clamp(0, 1))).abs()
        assert float((off > 1).float().mean()) <= 0.01
        assert float(off.max()) <= 4


@BOTH
def test_a_list_of_opaque_splats_shows_the_nearest_one(kind):
    """Order within a run, across the four quarters of it, across runs and across stages of the kernel."""
    n = 600
    colors = torch.zeros(n, 3)
    colors[:, 1] = 1.0
    for nearest in (0, 1, 2, 63, 255, 256, 599):
        depths = [5.0 + 0.01 * i for i in range(n)]
        depths[nearest] = 4.0
        shown = colors.clone()
        shown[nearest] = torch.tensor([1.0, 0.0, 0.0])
        g = splats([[0, 0, z] for z in depths], opacities=[1.0] * n, scales=[0.5] * n, colors=shown)
        image = kind().render(cast_inputs(g, device="cuda"), front_camera(), RasterOptions()).image
        assert float((image[:, 32, 32].cpu() - torch.tensor([0.99, 0.01, 0.0])).abs().max()) < 1e-3


@BOTH
def test_faint_splats_add_up_over_runs_and_stages(kind):
    """600 splats of alpha a in the middle of a pixel: 1 - (1 - a)^n, in closed form, before the stop."""
    n, alpha = 600, 0.0075
    cam = front_camera(cx=32.5, cy=32.5)
    g = splats([[0, 0, 4.0]] * n, opacities=[alpha] * n, colors=torch.ones(n, 3))
    image = kind().render(cast_inputs(g, device="cuda"), cam, RasterOptions()).image
    assert abs(float(image[0, 32, 32]) - (1 - (1 - alpha) ** n)) < 2e-5


@BOTH
def test_nothing_to_draw_gives_the_background(kind):
    background = torch.tensor([0.1, 0.5, 0.9])
    g = cast_inputs(splats([], opacities=[]), device="cuda")
    image = kind().render(g, front_camera(width=20, height=17), RasterOptions(background=background)).image
    assert torch.equal(image.cpu(), background[:, None, None].expand(3, 17, 20))


@BOTH
def test_broken_gaussians_leave_no_trace(kind):
    g, cam = on_gpu(MANY)
    exact = kind().render(g, cam, RasterOptions()).image
    extra = [x[:4].clone() for x in (g.means, g.opacities, g.scales, g.quats, g.sh.dense)]
    extra[0][0, 0], extra[1][1], extra[2][2, 1], extra[4][3, 0, 0] = (float("nan"), *[float("inf")] * 3)
    joined = [
        torch.cat([a, b]) for a, b in zip((g.means, g.opacities, g.scales, g.quats, g.sh.dense), extra, strict=True)
    ]
    seen = kind().render(replace(g, means=joined[0], opacities=joined[1], scales=joined[2], quats=joined[3],
                                 sh=replace(g.sh, dense=joined[4])), cam, RasterOptions())  # fmt: skip
    # One of them leaves a hole in the lists: runs begin elsewhere, and warps stop a splat earlier or later.
    assert float((seen.image - exact).abs().max()) <= 2e-4


@BOTH
def test_what_it_cannot_do_is_refused(kind):
    g, cam = on_gpu(MANY)
    with torch.enable_grad(), pytest.raises(CapabilityError, match="BACKWARD"):
        kind().render(replace(g, means=g.means.clone().requires_grad_()), cam, RasterOptions())
    for options in (RasterOptions(depth=frozenset({"median"})), RasterOptions(absgrad=True)):
        with pytest.raises(CapabilityError):
            kind().render(g, cam, options)


def test_a_low_pass_too_small_for_halves_is_refused():
    g, cam = on_gpu(MANY)
    with pytest.raises(ConfigError, match="eps2d"):
        TensorCoreRasterizer().render(g, cam, RasterOptions(eps2d=0.01))


def test_it_is_taken_only_where_its_precision_is_accepted():
    plugins = load_plugins()
    g, cam = on_gpu(MANY)
    for accepted, served in ((("exact", "tight"), "standard"), (("exact", "approx-fp16"), "tcgs")):
        rasterizer = NegotiatedRasterizer(plugins, device="cuda", exactness=accepted)
        rasterizer.render(g, cam, RasterOptions())
        assert list(rasterizer.choices.values()) == [served]
    rasterizer = NegotiatedRasterizer(plugins, device="cuda", prefer=["flash"], exactness=("exact", "approx-uint8"))
    assert rasterizer.render(g, cam, RasterOptions(dtype_out="uint8")).image.dtype == torch.uint8
    assert set(rasterizer.choices.values()) == {"flash"}


def test_absgrad_of_more_channels_than_a_launch_blends_is_refused():
    g, cam = on_gpu(replace(MANY, features=6))
    with pytest.raises(CapabilityError, match="up to 8 channels"):
        StandardRasterizer().render(g, cam, RasterOptions(absgrad=True))
    g, cam = on_gpu(replace(MANY, features=5))
    with torch.enable_grad():
        result = StandardRasterizer().render(g, cam, RasterOptions(absgrad=True))
        (result.image.sum() + result.features.sum()).backward()
    assert float(result.absgrad2d.value.abs().sum()) > 0
