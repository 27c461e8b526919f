"""The rasterizer of surfels on a GPU: the same facts as on the CPU, and agreement with the oracle and the CPU."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from sw_reference.projection import rotation_matrices
from sw_reference.rasterizer import ReferenceRasterizer
from sw_reference.testing.raster_gradients import GRADIENT_CASES, applies, check_against, outputs, run
from sw_reference.testing.raster_scenes import (
    RasterCase,
    cast_inputs,
    draw_scene,
    front_camera,
    permute_inputs,
    with_tensors,
)
from sw_reference.testing.raster_surfels import surfels
from sw_reference.testing.rasterizer_checks import checks_for

from splatwizard_core.api import SH, CapabilityError, RasterOptions
from sw_rasterizers.native import unavailable_on_cuda
from sw_rasterizers.surfel import SurfelRasterizer

pytestmark = [
    pytest.mark.cuda,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU"),
    pytest.mark.skipif(unavailable_on_cuda() is not None, reason=str(unavailable_on_cuda())),
]
INFO = SurfelRasterizer.info.on("cuda")
CASES = [case for case in GRADIENT_CASES if applies(case, INFO)] if torch.cuda.is_available() else []
ALL_DEPTHS = frozenset({"inverse", "accumulated", "expected", "median"})
EVERYTHING = RasterOptions(alpha=True, depth=ALL_DEPTHS, normals=True, distortion=True, grad2d=True)
MANY = RasterCase("many", n=3000, width=203, height=150, spread=2.0, scale=(0.01, 0.25), degree=3, geometry="surfels")
"""Fills 13 x 10 tiles, the last ones partial, with lists longer than a stage of the kernels."""


@pytest.mark.parametrize("check", checks_for(INFO), ids=str)
def test_facts_of_every_rasterizer_of_surfels(check):
    check(SurfelRasterizer(), "cuda")


def test_five_kinds_of_scenes_apply():
    assert [case.name for case in CASES] == [c.name for c in GRADIENT_CASES if c.geometry == "surfels"]


@pytest.mark.parametrize("case", CASES, ids=lambda c: c.name)
@pytest.mark.parametrize("seed", [1, 2])
def test_values_and_gradients_are_those_of_the_reference(case, seed):
    check_against(SurfelRasterizer(), ReferenceRasterizer(), case, seed, "cuda")


def split(g):
    sh = g.sh.dense
    return replace(g, sh=SH(dc=sh[:, :1].clone(), rest=sh[:, 1:].clone(), active_degree=g.sh.active_degree))


def facing(g, cam):
    """|cos| between the surfels' normals and the rays to their centres."""
    t = g.means @ cam.R.T + cam.tau
    normals = (cam.R @ rotation_matrices(g.quats))[:, :, 2]
    return (normals * t).sum(1).abs() / t.norm(dim=1)


def many(changes, seed):
    """Without surfels within two degrees of edge-on: their depth changes by more than itself from pixel to pixel."""
    g, cam = draw_scene(replace(MANY, **changes), seed)
    g = permute_inputs(g, (facing(g, cam) > 0.03).nonzero()[:, 0])
    g.opacities[:50] = 1.0  # the clamp of alpha is active somewhere
    return cast_inputs(g, torch.float32), cam


def relative(found, expected):
    return float((found.cpu().double() - expected.double()).norm() / expected.double().norm().clamp(min=1e-30))


def as_on_the_cpu(g, cam, options):
    """Tolerances of specs for unfiltered scenes: a cut may flip on rounding, in few places and by little."""
    rasterizer = SurfelRasterizer()
    expected, wanted = run(rasterizer, g, cam, options)
    actual, found = run(rasterizer, cast_inputs(g, torch.float32, "cuda"), cam, options)
    difference = (actual.radii.cpu() - expected.radii).abs()
    assert int(difference.max()) <= 1
    assert float((difference > 0).float().mean()) <= 1e-4
    reference = outputs(expected)
    for name, x in outputs(actual).items():
        scale = max(1.0, float(reference[name].detach().abs().max()))
        error = (x.detach().cpu() - reference[name].detach()).abs() / scale
        # Median depth is one surfel's: it may jump where T crosses 1/2 on rounding.
        assert float((error > 2e-5).float().mean()) <= 1e-4, name
        assert name == "depth median" or float(error.max()) <= 0.012, name
    pairs = {name: (x, wanted[name]) for name, x in found.items()}
    if expected.grad2d is not None:
        pairs["grad2d"] = (actual.grad2d.value, expected.grad2d.value)
    for name, (a, b) in pairs.items():
        error = relative(a, b)
        assert error <= 1e-3, f"gradient of {name}: relative error {error:.3g}"


@pytest.mark.parametrize(
    ("form", "options", "changes"),
    [
        ("dense", RasterOptions(grad2d=True), {}),
        ("split", RasterOptions(clamp_grad="pass", scale_modifier=1.4, background=torch.rand(3)), {}),
        ("split", EVERYTHING, {}),
        ("dense", replace(EVERYTHING, profile="dgr-exact"), {}),
        ("dense", replace(EVERYTHING, clamp_color=False), {"degree": 3, "active_degree": 1}),
        ("split", RasterOptions(normals=True), {"degree": 1, "active_degree": 0}),
        ("colors", EVERYTHING, {"color": "colors"}),
    ],
    ids=["plain", "pass", "everything", "dgr-exact", "bands", "dc", "colors"],
)
def test_many_surfels_equal_the_kernels_of_the_cpu(form, options, changes):
    g, cam = many(changes, 3)
    as_on_the_cpu(split(g) if form == "split" else g, cam, options)


def test_edge_on_surfels_are_as_exact_as_on_the_cpu():
    """Beside the kernels of the CPU in float64: no further off than those in float32, but for a factor."""
    wide, cam = draw_scene(replace(MANY, color="colors"), 3)
    assert float(facing(wide, cam).min()) < 0.01
    _, wanted = run(SurfelRasterizer(), wide, cam, EVERYTHING)
    g = cast_inputs(wide, torch.float32)
    _, single = run(SurfelRasterizer(), g, cam, EVERYTHING)
    _, found = run(SurfelRasterizer(), cast_inputs(g, device="cuda"), cam, EVERYTHING)
    for name, x in found.items():
        limit = max(1e-3, 4 * relative(single[name], wanted[name]))
        assert relative(x, wanted[name]) <= limit <= 0.05, name


@pytest.mark.parametrize("profile", ["3dgs", "dgr-exact"])
def test_surfels_that_reach_behind_the_camera_equal_the_kernels_of_the_cpu(profile):
    g, cam = draw_scene(replace(MANY, n=300, scale=(0.3, 2.0)), 4, torch.float32)
    g.opacities *= 0.1
    as_on_the_cpu(g, cam, replace(EVERYTHING, profile=profile))


@pytest.mark.parametrize("seed", range(4))
def test_no_pixel_of_a_surfel_near_the_camera_is_lost(seed):
    """Planes of all directions around the camera, thin ones too, close enough that most have no bounded outline."""
    g, cam = draw_scene(replace(MANY, n=80, scale=(0.02, 1.5), opacity=(0.05, 0.15), color="colors"), seed)
    depth = 0.25 + 1.5 * torch.rand(80, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    t = g.means @ cam.R.T + cam.tau
    t = torch.cat([t[:, :2] / t[:, 2:] * depth[:, None], depth[:, None]], dim=1)
    g.means = (t - cam.tau) @ cam.R
    single = cast_inputs(g, torch.float32)
    options = RasterOptions(alpha=True)
    counting = SurfelRasterizer(count=True)
    expected = counting.render(single, cam, options)
    result = counting.render(cast_inputs(single, device="cuda"), cam, options)
    assert abs(result.stats.n_blended - expected.stats.n_blended) <= 1e-4 * expected.stats.n_blended
    assert float(((result.alpha.cpu() - expected.alpha).abs() > 2e-5).float().mean()) <= 1e-4
    assert set(result.stats.stage_seconds) == set(expected.stats.stage_seconds)


def test_median_depth_jumps_in_few_pixels():
    g, cam = draw_scene(MANY, 5, torch.float32)
    options = RasterOptions(depth=frozenset({"median"}))
    expected = SurfelRasterizer().render(g, cam, options).depth["median"]
    found = SurfelRasterizer().render(cast_inputs(g, device="cuda"), cam, options).depth["median"].cpu()
    assert float((found > 0).float().mean()) > 0.1
    assert float(((found - expected).abs() > 2e-5 * float(expected.max())).float().mean()) <= 1e-4


def test_asking_for_maps_changes_no_image():
    g, cam = draw_scene(MANY, 5, torch.float32)
    moved = cast_inputs(g, device="cuda")
    plain = SurfelRasterizer().render(moved, cam, RasterOptions()).image
    assert torch.equal(plain, SurfelRasterizer().render(moved, cam, EVERYTHING).image)


@pytest.mark.parametrize("output", ["normals", "distortion", "alpha", "median", "image"])
def test_the_gradient_of_one_output_alone_is_that_of_the_cpu(output):
    g, cam = draw_scene(replace(MANY, n=1000), 6, torch.float32)
    gradients = []
    for device in ("cpu", "cuda"):
        moved = cast_inputs(g, device=device)
        leaves = {k: x.detach().clone().requires_grad_() for k, x in moved.tensors().items()}
        result = SurfelRasterizer().render(with_tensors(moved, leaves), cam, EVERYTHING)
        drawn = result.depth["median"] if output == "median" else getattr(result, output)
        weights = torch.randn(drawn.shape, generator=torch.Generator().manual_seed(2)).to(device)
        (drawn * weights).sum().backward()
        gradients.append({k: torch.zeros_like(x) if x.grad is None else x.grad for k, x in leaves.items()})
    for name, value in gradients[0].items():
        error = float((gradients[1][name].cpu() - value).norm())
        assert error <= 1e-3 * float(value.norm()), f"gradient of {name}"
    assert float(gradients[0]["means"].norm()) > 0


def test_gradients_of_the_smallest_and_the_edge_on_surfels_are_finite():
    for scale in (1e-3, 1e-12, 1e-25, 1e-38):
        for angle in (0.0, 1.0, math.pi / 2 - 1e-3, math.pi / 2 - 1e-6):
            g = surfels([[0.1, 0, 4], [0.3, 0.1, 5]], opacities=[0.9, 0.8], scales=[scale, 0.2])
            g.quats = torch.tensor([[math.cos(angle / 2), 0.0, math.sin(angle / 2), 0.0], [1.0, 0, 0, 0]])
            result, gradients = run(SurfelRasterizer(), cast_inputs(g, device="cuda"), front_camera(), EVERYTHING)
            assert all(bool(torch.isfinite(x).all()) for x in outputs(result).values()), (scale, angle)
            assert all(bool(torch.isfinite(x).all()) for x in gradients.values()), (scale, angle)


def test_culled_rows_get_exactly_zero():
    g, cam = draw_scene(replace(MANY, spread=6.0), 7, torch.float32)
    for form in (g, split(g)):
        result, gradients = run(SurfelRasterizer(), cast_inputs(form, device="cuda"), cam, EVERYTHING)
        culled = ~result.visible
        assert 0 < int(culled.sum()) < 3000
        for name, x in gradients.items():
            assert int(torch.count_nonzero(x[culled])) == 0, name
            assert int(torch.count_nonzero(x)) > 0, name


def test_float64_is_refused():
    g, cam = draw_scene(replace(MANY, n=20), 1)
    with pytest.raises(CapabilityError, match="FLOAT64"):
        SurfelRasterizer().render(cast_inputs(g, device="cuda"), cam, RasterOptions())


def test_no_state_is_kept_without_gradient():
    g, cam = draw_scene(MANY, 3, torch.float32)
    moved = cast_inputs(g, device="cuda")
    with torch.no_grad():
        SurfelRasterizer().render(moved, cam, RasterOptions())
        before = torch.cuda.memory_allocated()
        result = SurfelRasterizer().render(moved, cam, RasterOptions())
    assert torch.cuda.memory_allocated() - before <= 2 * (result.image.nbytes + result.radii.nbytes) + 4096
