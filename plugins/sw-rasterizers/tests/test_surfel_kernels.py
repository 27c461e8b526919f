"""The compiled rasterizer of surfels: facts, finite differences, agreement with the oracle, what kernels promise."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from sw_reference.projection import rotation_matrices
from sw_reference.rasterizer import ReferenceRasterizer
from sw_reference.surfels import warn_of_low_pass
from sw_reference.testing.raster_gradients import (
    GRADIENT_CASES,
    applies,
    check_against,
    check_gradients,
    outputs,
    run,
)
from sw_reference.testing.raster_scenes import RasterCase, cast_inputs, draw_scene, front_camera, with_tensors
from sw_reference.testing.raster_surfels import surfels
from sw_reference.testing.rasterizer_checks import checks_for

from splatwizard_core.api import SH, CapabilityError, Feature, RasterOptions, ScoreSpec, ShapeError
from splatwizard_core.tooling import NegotiatedRasterizer, load_plugins
from sw_rasterizers import cpu
from sw_rasterizers.call import Call, Flag, camera_numbers
from sw_rasterizers.native import MODULE
from sw_rasterizers.surfel import SurfelRasterizer

pytestmark = pytest.mark.skipif(MODULE.available() is not None, reason=str(MODULE.available()))
CASES = [case for case in GRADIENT_CASES if applies(case, SurfelRasterizer.info)]
ALL_DEPTHS = frozenset({"inverse", "accumulated", "expected", "median"})
EVERYTHING = RasterOptions(alpha=True, depth=ALL_DEPTHS, normals=True, distortion=True, grad2d=True)
MANY = RasterCase("many", n=600, width=75, height=50, spread=2.0, scale=(0.01, 0.25), degree=3, geometry="surfels")
"""Fills 5 x 4 tiles, the last ones partial, with lists longer than a stage of the kernels."""


@pytest.fixture
def threads():
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.fixture(autouse=True)
def _one_thread(threads):
    threads(1)


def split(g):
    sh = g.sh.dense
    return replace(g, sh=SH(dc=sh[:, :1].clone(), rest=sh[:, 1:].clone(), active_degree=g.sh.active_degree))


@pytest.mark.parametrize("check", checks_for(SurfelRasterizer.info), ids=str)
def test_facts_of_every_rasterizer_of_surfels(check):
    check(SurfelRasterizer())


def test_five_kinds_of_scenes_apply():
    assert [case.name for case in CASES] == [c.name for c in GRADIENT_CASES if c.geometry == "surfels"]
    assert len(CASES) == 5
    assert len(checks_for(SurfelRasterizer.info)) >= 28


@pytest.mark.parametrize("case", CASES, ids=lambda c: c.name)
def test_float64_gradients_are_the_derivatives(case):
    check_gradients(SurfelRasterizer(), case)


@pytest.mark.parametrize("case", CASES, ids=lambda c: c.name)
@pytest.mark.parametrize("seed", [1, 2])
def test_float32_values_and_gradients_are_those_of_the_reference(case, seed):
    check_against(SurfelRasterizer(), ReferenceRasterizer(), case, seed)


def in_float64(g, cam, options):
    """Everything to rounding, the statistic included."""
    result, gradients = run(SurfelRasterizer(), g, cam, options)
    expected, expected_gradients = run(ReferenceRasterizer(), g, cam, options)
    assert torch.equal(result.radii, expected.radii)
    assert result.stats.n_visible == expected.stats.n_visible
    wanted = outputs(expected)
    for name, x in outputs(result).items():
        scale = float(wanted[name].detach().abs().max())
        assert float((x - wanted[name]).detach().abs().max()) <= 1e-10 * max(1.0, scale), name
    if result.grad2d is not None:
        gradients["grad2d"], expected_gradients["grad2d"] = result.grad2d.value, expected.grad2d.value
    for name, value in gradients.items():
        other = expected_gradients[name]
        assert float(other.norm()) > 0, name
        assert float((value - other).norm()) <= 1e-7 * float(other.norm()), name


@pytest.mark.parametrize(
    ("form", "options"),
    [
        ("dense", RasterOptions(grad2d=True)),
        ("split", RasterOptions(clamp_grad="pass", scale_modifier=1.4)),
        ("split", EVERYTHING),
        ("dense", replace(EVERYTHING, profile="dgr-exact")),
    ],
    ids=["plain", "pass", "everything", "dgr-exact"],
)
def test_many_surfels_equal_the_reference_in_float64(form, options):
    g, cam = draw_scene(MANY, 3)
    g.opacities[:50] = 1.0  # the clamp of alpha is active somewhere
    if form == "split":
        g = split(g)
    background = torch.rand(3, 50, 75, generator=torch.Generator().manual_seed(1)).double()
    in_float64(g, cam, replace(options, background=background))


def test_surfels_that_reach_behind_the_camera_equal_the_reference():
    g, cam = draw_scene(replace(MANY, n=60, scale=(0.5, 3.0)), 4)
    g.opacities *= 0.3
    in_float64(g, cam, EVERYTHING)


@pytest.mark.parametrize("seed", range(4))
def test_no_pixel_of_a_surfel_near_the_camera_is_lost(seed):
    """Planes of all directions around the camera, thin ones too, close enough that most have no bounded outline."""
    g, cam = draw_scene(replace(MANY, n=80, scale=(0.02, 1.5), opacity=(0.05, 0.15), color="colors"), seed)
    depth = 0.25 + 1.5 * torch.rand(80, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    t = g.means @ cam.R.T + cam.tau
    t = torch.cat([t[:, :2] / t[:, 2:] * depth[:, None], depth[:, None]], dim=1)
    g.means = (t - cam.tau) @ cam.R
    result = SurfelRasterizer(count=True).render(g, cam, RasterOptions(alpha=True))
    expected = ReferenceRasterizer().render(g, cam, RasterOptions(alpha=True))
    assert torch.equal(result.radii, expected.radii)
    assert result.stats.n_blended == expected.stats.n_blended
    torch.testing.assert_close(result.alpha, expected.alpha, atol=1e-12, rtol=0)
    axes = (cam.R @ rotation_matrices(g.quats))[:, 2, :2] * g.scales
    assert int((depth < 3 * axes.norm(dim=1)).sum()) > 20


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_results_are_bit_equal_for_any_number_of_threads(threads, dtype):
    g, cam = draw_scene(replace(MANY, n=4000), 4, dtype)
    found = []
    for count in (1, 2, 3):
        threads(count)
        for opt in (EVERYTHING, RasterOptions(grad2d=True)):
            result, gradients = run(SurfelRasterizer(), g, cam, opt)
            found.append([result.radii, result.grad2d.value, *outputs(result).values(), *gradients.values()])
    for i in (0, 1):
        for other in (found[i + 2], found[i + 4]):
            assert all(torch.equal(a, b) for a, b in zip(found[i], other, strict=True))


def test_asking_for_maps_changes_no_image():
    g, cam = draw_scene(MANY, 5, torch.float32)
    plain = SurfelRasterizer().render(g, cam, RasterOptions()).image
    assert torch.equal(plain, SurfelRasterizer().render(g, cam, EVERYTHING).image)


@pytest.mark.parametrize("output", ["normals", "distortion", "alpha", "median", "image"])
def test_the_gradient_of_one_output_alone_is_that_of_the_reference(output):
    g, cam = draw_scene(replace(MANY, n=100), 6)
    gradients = []
    for rasterizer in (SurfelRasterizer(), ReferenceRasterizer()):
        leaves = {k: x.clone().requires_grad_() for k, x in g.tensors().items()}
        result = rasterizer.render(with_tensors(g, leaves), cam, EVERYTHING)
        drawn = result.depth["median"] if output == "median" else getattr(result, output)
        weights = torch.randn(drawn.shape, generator=torch.Generator().manual_seed(2)).double()
        (drawn * weights).sum().backward()
        zero = {k: torch.zeros_like(x) for k, x in leaves.items()}
        gradients.append({k: zero[k] if x.grad is None else x.grad for k, x in leaves.items()})
    for name, value in gradients[0].items():
        other = gradients[1][name]
        assert float((value - other).norm()) <= 1e-7 * float(other.norm()) + 1e-12, name
    assert float(gradients[1]["means"].norm()) > 0


def test_distortion_keeps_its_digits_where_depths_are_nearly_equal():
    """Two sheets 0.1 apart at depth 50: m differs by 8e-6, whose square float32 would lose beside m = 1."""
    g = surfels([[0, 0, 50], [0, 0, 50.1]], opacities=[0.5, 0.5], scales=[20.0, 20.0])
    drawn = SurfelRasterizer().render(g, front_camera(), RasterOptions(distortion=True)).distortion
    wide = cast_inputs(g, torch.float64)
    wide.means = torch.tensor([[0, 0, 50], [0, 0, 50.1]], dtype=torch.float64)
    cam = front_camera().to(dtype=torch.float64)
    expected = ReferenceRasterizer().render(wide, cam, RasterOptions(distortion=True)).distortion
    torch.testing.assert_close(drawn.double(), expected, rtol=2e-3, atol=0)


def test_gradients_of_the_smallest_and_the_edge_on_surfels_are_finite():
    for scale in (1e-3, 1e-12, 1e-25, 1e-38):
        for angle in (0.0, 1.0, math.pi / 2 - 1e-3, math.pi / 2 - 1e-6):
            g = surfels([[0.1, 0, 4], [0.3, 0.1, 5]], opacities=[0.9, 0.8], scales=[scale, 0.2])
            g.quats = torch.tensor([[math.cos(angle / 2), 0.0, math.sin(angle / 2), 0.0], [1.0, 0, 0, 0]])
            result, gradients = run(SurfelRasterizer(), g, front_camera(), EVERYTHING)
            assert all(bool(torch.isfinite(x).all()) for x in outputs(result).values()), (scale, angle)
            assert all(bool(torch.isfinite(x).all()) for x in gradients.values()), (scale, angle)


def test_gradients_only_where_they_are_asked_for():
    g, cam = draw_scene(replace(MANY, n=300), 6, torch.float32)
    g = split(g)
    g.opacities.requires_grad_()
    result = SurfelRasterizer().render(g, cam, RasterOptions(grad2d=True))
    with pytest.raises(RuntimeError, match="after backward"):
        _ = result.grad2d.value
    result.image.sum().backward()
    assert g.opacities.grad is not None
    assert [x.grad for x in (g.means, g.scales, g.quats, g.sh.dc, g.sh.rest)] == [None] * 5
    assert float(result.grad2d.value.abs().max()) > 0
    with torch.no_grad():
        silent = SurfelRasterizer().render(g, cam, RasterOptions(grad2d=True))
    assert silent.image.grad_fn is None
    assert silent.grad2d is None


def test_culled_rows_get_exactly_zero():
    g, cam = draw_scene(replace(MANY, n=3000, spread=6.0), 7, torch.float32)
    for form in (g, split(g)):
        result, gradients = run(SurfelRasterizer(), form, cam, EVERYTHING)
        culled = ~result.visible
        assert 0 < int(culled.sum()) < 3000
        for name, x in gradients.items():
            assert int(torch.count_nonzero(x[culled])) == 0, name
            assert int(torch.count_nonzero(x)) > 0, name


def test_tight_tiles_are_fewer_than_the_published_ones():
    g, cam = draw_scene(replace(MANY, scale=(0.01, 0.3)), 8, torch.float32)
    tight = SurfelRasterizer().render(g, cam, RasterOptions()).stats
    classic = SurfelRasterizer().render(g, cam, RasterOptions(profile="dgr-exact")).stats
    assert 0 < tight.n_pairs < classic.n_pairs
    assert tight.n_visible == classic.n_visible


def test_counting_mode_counts_what_the_reference_counts():
    g, cam = draw_scene(replace(MANY, n=300), 8)
    ours = SurfelRasterizer(count=True).render(g, cam, RasterOptions()).stats
    reference = ReferenceRasterizer().render(g, cam, RasterOptions()).stats
    assert ours.n_blended == reference.n_blended
    assert ours.n_blended < ours.n_evaluated <= reference.n_evaluated
    assert SurfelRasterizer().render(g, cam, RasterOptions()).stats.n_blended is None


def test_state_of_the_backward_pass_survives_other_renders():
    g, cam = draw_scene(replace(MANY, n=2000), 9, torch.float32)
    leaves = {k: x.clone().requires_grad_() for k, x in g.tensors().items()}
    result = SurfelRasterizer().render(with_tensors(g, leaves), cam, EVERYTHING)
    for seed in range(3):
        run(SurfelRasterizer(), draw_scene(replace(MANY, n=2000), seed, torch.float32)[0], cam, EVERYTHING)
    result.distortion.sum().backward()
    fresh = {k: x.clone().requires_grad_() for k, x in g.tensors().items()}
    SurfelRasterizer().render(with_tensors(g, fresh), cam, EVERYTHING).distortion.sum().backward()
    assert torch.equal(leaves["means"].grad, fresh["means"].grad)


@pytest.mark.parametrize(
    ("options", "changes", "message"),
    [
        (RasterOptions(antialias=True), {}, "ANTIALIAS"),
        (RasterOptions(absgrad=True), {}, "ABSGRAD"),
        (RasterOptions(scores=(ScoreSpec("h", "hits"),)), {}, "SCORE_HITS"),
        (RasterOptions(), {"features": torch.zeros(20, 2)}, "EXTRA_FEATURES"),
        (RasterOptions(), {"sh": None, "colors": torch.zeros(20, 4)}, "COLORS_ND"),
        (RasterOptions(), {"scales": torch.ones(20, 3)}, "draws nothing without SURFEL"),
    ],
)
def test_what_is_not_offered_is_refused(options, changes, message):
    g, cam = draw_scene(replace(MANY, n=20), 1, torch.float32)
    with pytest.raises(CapabilityError, match=message):
        SurfelRasterizer().render(replace(g, **changes), cam, options)


@pytest.mark.parametrize("rasterizer", [SurfelRasterizer, ReferenceRasterizer])
def test_a_low_pass_that_surfels_do_not_have_is_told_once(rasterizer, caplog):
    warn_of_low_pass.cache_clear()
    g, cam = draw_scene(replace(MANY, n=20), 1, torch.float32)
    plain = rasterizer().render(g, cam, RasterOptions()).image
    assert not caplog.records
    for _ in range(2):
        assert torch.equal(rasterizer().render(g, cam, RasterOptions(eps2d=2.0)).image, plain)
    assert [r.getMessage() for r in caplog.records] == [
        "eps2d = 2 has no effect on surfels, which have a low-pass of their own"
    ]


def test_the_ops_read_no_further_than_there_is():
    g, cam = draw_scene(replace(MANY, n=20), 1, torch.float32)
    call = Call(camera_numbers(cam), 75, 50, 0, 1.0, 0.0, Flag.SURFELS)
    for scales, quats, told in (
        (torch.ones(20, 3), g.quats, r"scales must be \[20, 2\]"),
        (g.scales[:19], g.quats, "quats must be a contiguous"),
        (g.scales[:19], g.quats[:19], "19 scales of 20 Gaussians"),
        (g.scales, g.quats[:, :3].contiguous(), "quats must be a contiguous"),
    ):
        with pytest.raises(RuntimeError, match=told):
            cpu.visible_radii(call, {"means": g.means, "scales": scales, "quats": quats})
    with pytest.raises(RuntimeError, match="image of 0 x 50"):
        cpu.visible_radii(replace(call, width=0), {"means": g.means, "scales": g.scales, "quats": g.quats})
    with pytest.raises(ShapeError):
        SurfelRasterizer().visible_filter(replace(g, quats=g.quats[:, :3]), cam)
    with pytest.raises(CapabilityError, match="SURFEL"):
        SurfelRasterizer().visible_filter(replace(g, scales=torch.ones(20, 3)), cam)


def test_registered_and_found_by_what_2dgs_asks_for():
    plugins = load_plugins()
    entry = plugins.rasterizers.entry("2dgs")
    assert entry.load() is SurfelRasterizer
    assert {Feature[name].name for name in entry.declared["features"]} == SurfelRasterizer.info.features
    wanted = {"BACKWARD", "SURFEL", "NORMALS", "DISTORTION", "ALPHA_MAP", "DEPTH_EXPECTED", "DEPTH_MEDIAN"}
    negotiated = NegotiatedRasterizer(plugins, device="cpu")
    assert negotiated.select(wanted).info.name == "2dgs"
    g, cam = draw_scene(replace(MANY, n=50), 1, torch.float32)
    result = negotiated.render(g, cam, EVERYTHING)
    assert result.normals is not None
    assert set(negotiated.choices.values()) == {"2dgs"}
    assert torch.equal(negotiated.visible_filter(g, cam), result.radii)
    assert negotiated.select({"BACKWARD"}).info.name != "2dgs"
