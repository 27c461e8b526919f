"""The standard rasterizer on a GPU: the same facts as on the CPU, and agreement with the CPU's kernels."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from sw_reference.rasterizer import ReferenceRasterizer
from sw_reference.testing.raster_gradients import GRADIENT_CASES, applies, check_against, outputs, run
from sw_reference.testing.raster_scenes import RasterCase, cast_inputs, draw_scene
from sw_reference.testing.rasterizer_checks import checks_for

from splatwizard_core.api import SH, Camera, CapabilityError, GaussianInputs, RasterOptions
from sw_rasterizers.native import unavailable_on_cuda
from sw_rasterizers.standard import StandardRasterizer

pytestmark = [
    pytest.mark.cuda,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU"),
    pytest.mark.skipif(unavailable_on_cuda() is not None, reason=str(unavailable_on_cuda())),
]
INFO = StandardRasterizer.info.on("cuda")
CASES = [case for case in GRADIENT_CASES if applies(case, INFO)] if torch.cuda.is_available() else []
ALL_DEPTHS = frozenset({"inverse", "accumulated", "expected", "median"})
MANY = RasterCase("many", n=3000, width=203, height=150, spread=2.0, scale=(0.01, 0.25), degree=3)
"""Fills 13 x 10 tiles, the last ones partial, with lists longer than a stage of the kernels."""


@pytest.mark.parametrize("check", checks_for(INFO), ids=str)
def test_facts_of_every_rasterizer(check):
    check(StandardRasterizer(), "cuda")


@pytest.mark.parametrize("case", CASES, ids=lambda c: c.name)
@pytest.mark.parametrize("seed", [1, 2])
def test_values_and_gradients_are_those_of_the_reference(case, seed):
    check_against(StandardRasterizer(), ReferenceRasterizer(), case, seed, "cuda")


def split(g):
    sh = g.sh.dense
    return replace(g, sh=SH(dc=sh[:, :1].clone(), rest=sh[:, 1:].clone(), active_degree=g.sh.active_degree))


@pytest.mark.parametrize(
    ("form", "options", "changes"),
    [
        ("dense", RasterOptions(grad2d=True, absgrad=True), {}),
        ("split", RasterOptions(clamp_grad="pass", scale_modifier=1.4, eps2d=0.1, background=torch.rand(3)), {}),
        ("split", RasterOptions(alpha=True, depth=ALL_DEPTHS, grad2d=True, absgrad=True, antialias=True), {}),
        ("dense", RasterOptions(profile="dgr-exact", grad2d=True), {}),
        ("dense", RasterOptions(grad2d=True, absgrad=True), {"width": 900, "height": 900}),  # whole lists: 3,249 tiles
        ("dense", RasterOptions(), {"features": 11}),
        ("dense", RasterOptions(features_detach_geometry=True), {"features": 11}),
        ("colors", RasterOptions(alpha=True), {"color": "colors", "channels": 10}),
        ("colors", RasterOptions(), {"color": "colors", "geometry": "cov3d"}),
        ("dense", RasterOptions(), {"degree": 3, "active_degree": 1}),
        ("split", RasterOptions(), {"degree": 1, "active_degree": 0}),
    ],
    ids=[
        "plain",
        "pass",
        "everything",
        "dgr-exact",
        "large",
        "features",
        "detached",
        "ten-colors",
        "cov3d",
        "bands",
        "dc",
    ],
)
def test_many_splats_equal_the_kernels_of_the_cpu(form, options, changes):
    """Tolerances of specs for unfiltered scenes: a cut may flip on rounding, in few places and by little."""
    g, cam = draw_scene(replace(MANY, **changes), 3, torch.float32)
    g.opacities[:50] = 1.0  # the clamp of alpha is active somewhere
    if form == "split":
        g = split(g)
    rasterizer = StandardRasterizer()
    expected, wanted = run(rasterizer, g, cam, options)
    actual, found = run(rasterizer, cast_inputs(g, torch.float32, "cuda"), cam, options)
    difference = (actual.radii.cpu() - expected.radii).abs()
    assert int(difference.max()) <= 1
    assert float((difference > 0).float().mean()) <= 1e-4
    reference = outputs(expected)
    for name, x in outputs(actual).items():
        scale = max(1.0, float(reference[name].detach().abs().max()))
        error = (x.detach().cpu() - reference[name].detach()).abs() / scale
        # Median depth is one splat's: it may jump where T crosses 1/2 on rounding.
        assert float((error > 2e-5).float().mean()) <= 1e-4, name
        assert name == "depth median" or float(error.max()) <= 0.012, name
    pairs = {name: (x, wanted[name]) for name, x in found.items()}
    for name in ("grad2d", "absgrad2d"):
        if getattr(expected, name) is not None:
            pairs[name] = (getattr(actual, name).value, getattr(expected, name).value)
    for name, (a, b) in pairs.items():
        error = float((a.cpu().double() - b.double()).norm() / b.double().norm().clamp(min=1e-30))
        assert error <= 1e-3, f"gradient of {name}: relative error {error:.3g}"


def test_float64_is_refused():
    g, cam = draw_scene(RasterCase(), 1)
    with pytest.raises(CapabilityError, match="FLOAT64"):
        StandardRasterizer().render(cast_inputs(g, device="cuda"), cam, RasterOptions())


def test_no_state_is_kept_without_gradient():
    g, cam = draw_scene(MANY, 3, torch.float32)
    moved = cast_inputs(g, device="cuda")
    with torch.no_grad():
        StandardRasterizer().render(moved, cam, RasterOptions())
        before = torch.cuda.memory_allocated()
        result = StandardRasterizer().render(moved, cam, RasterOptions())
    assert torch.cuda.memory_allocated() - before <= 2 * (result.image.nbytes + result.radii.nbytes) + 4096


DEEP = RasterCase(
    "deep", n=6000, width=70, height=50, spread=1.0, scale=(0.02, 0.3), opacity=(0.005, 0.05), degree=1, active_degree=1
)
"""20 tiles with lists of a thousand and more, of which all pixels see many: cut into pieces for the backward pass."""


@pytest.mark.parametrize("absgrad", [False, True])
@pytest.mark.parametrize("opacity", [(0.005, 0.05), (0.2, 0.9)], ids=["deep", "opaque"])
def test_lists_that_are_cut_for_the_backward_pass_give_the_gradients_of_whole_ones(absgrad, opacity):
    g, cam = draw_scene(replace(DEEP, opacity=opacity), 5, torch.float32)
    g = cast_inputs(g, torch.float32, "cuda")
    options = RasterOptions(alpha=True, grad2d=True, absgrad=absgrad, background=torch.rand(3, device="cuda"))
    whole, wanted = run(StandardRasterizer(count=True), g, cam, options)  # counting walks whole lists
    cut, found = run(StandardRasterizer(), g, cam, options)
    assert whole.stats.n_pairs > 20 * 3 * 256
    torch.testing.assert_close(cut.image, whole.image, rtol=0, atol=2e-6)
    torch.testing.assert_close(cut.alpha, whole.alpha, rtol=0, atol=1e-6)
    pairs = {name: (x, wanted[name]) for name, x in found.items()}
    for name in ("grad2d", "absgrad2d") if absgrad else ("grad2d",):
        pairs[name] = (getattr(cut, name).value, getattr(whole, name).value)
    for name, (a, b) in pairs.items():
        error = float((a.double() - b.double()).norm() / b.double().norm().clamp(min=1e-30))
        assert error <= 2e-5, f"gradient of {name}: relative error {error:.3g}"


LONG = replace(DEEP, n=20_000)
"""The same with lists of 2,000 to 5,000, whose pieces blocks share out in the forward pass."""


@pytest.mark.parametrize("background", [None, torch.rand(3), torch.rand(3, 50, 70)], ids=["black", "color", "image"])
@pytest.mark.parametrize("opacity", [(0.005, 0.012), (0.005, 0.05), (0.2, 0.9)], ids=["faint", "deep", "opaque"])
def test_lists_of_thousands_that_blocks_share_out_give_the_values_of_whole_ones(opacity, background):
    g, cam = draw_scene(replace(LONG, opacity=opacity), 5, torch.float32)
    g = cast_inputs(g, torch.float32, "cuda")
    options = RasterOptions(alpha=True, background=None if background is None else background.cuda())
    whole, wanted = run(StandardRasterizer(count=True), g, cam, options)  # counting walks whole lists
    shared, found = run(StandardRasterizer(), g, cam, options)
    assert whole.stats.n_pairs > 20 * 2000
    with torch.no_grad():
        kept_nothing = StandardRasterizer().render(g, cam, options)
    for name in ("image", "alpha"):
        values, expected = getattr(shared, name), getattr(whole, name)
        assert torch.equal(getattr(kept_nothing, name), values), name
        error = (values - expected).detach().abs()
        # Rounding may move a pixel's stop by a splat, which then weighs up to 0.99 of a T of 1e-4, times its colour.
        assert float((error > 3e-6).float().mean()) <= 1e-3, name
        assert float(error.max()) <= 3e-4, name
    for name, x in found.items():
        y = wanted[name].double()
        error = float((x.double() - y).norm() / y.norm().clamp(min=1e-30))
        assert error <= 1e-4, f"gradient of {name}: relative error {error:.3g}"


def test_a_list_of_thousands_is_drawn_as_by_the_reference():
    g, cam = draw_scene(replace(LONG, n=3000, width=16, height=16, spread=0.2, opacity=(0.005, 0.03)), 5, torch.float32)
    options = RasterOptions(alpha=True)
    with torch.no_grad():
        expected = ReferenceRasterizer().render(cast_inputs(g, torch.float64), cam, options)
        actual = StandardRasterizer().render(cast_inputs(g, torch.float32, "cuda"), cam, options)
    assert actual.stats.n_pairs > 2500
    for name in ("image", "alpha"):
        error = (getattr(actual, name).cpu().double() - getattr(expected, name)).abs()
        # As of the CPU's kernels: a splat of alpha 1/255 is drawn or not on rounding, in few places.
        assert float((error > 2e-5).float().mean()) <= 0.005, name
        assert float(error.max()) <= 0.012, name


def test_opacity_gradients_of_fragments_are_those_of_the_cpu():
    r = torch.Generator().manual_seed(1)
    n = 3000
    means = torch.cat([2 * torch.rand(n, 2, generator=r) - 1, 2 * torch.rand(n, 1, generator=r) + 3], dim=1)
    quats = torch.nn.functional.normalize(torch.rand(n, 4, generator=r) - 0.5, dim=1)
    values = means, 0.9 * torch.rand(n, generator=r) + 0.05, 0.1 * torch.rand(n, 3, generator=r) + 0.01, quats
    colors, truth = torch.rand(n, 3, generator=r), torch.rand(3, 200, 300, generator=r)
    camera = Camera(300, 200, 200.0, 200.0, 150.0, 100.0, torch.eye(3), torch.zeros(3))
    found = []
    for device in ("cpu", "cuda"):
        tensors = [x.to(device).requires_grad_() for x in values]
        g = GaussianInputs(*tensors, colors=colors.to(device))
        result = StandardRasterizer().render(g, camera.to(device), RasterOptions(fragment_grad=True, grad2d=True))
        (result.image - truth.to(device)).square().mean().backward()
        found.append(result.fragment_grad.value.cpu())
    cpu, cuda = found
    # A pixel at the limit of 1/255 may fall on the other side.
    assert ((cpu[:, 1] - cuda[:, 1]).abs() <= 2 + 1e-3 * cpu[:, 1]).all()
    assert torch.allclose(cpu[:, 0], cuda[:, 0], rtol=1e-2, atol=1e-3 * float(cpu[:, 0].max()))
