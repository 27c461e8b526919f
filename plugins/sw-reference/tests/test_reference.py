"""The reference rasterizer: every fact of the public checks, finite differences, and the naive loop as an oracle."""

import pytest
import torch
from forked_children import run_python
from sw_reference import compositing, plugin
from sw_reference.projection import rotation_matrices
from sw_reference.rasterizer import ReferenceRasterizer
from sw_reference.testing.naive_rasterizer import naive_render
from sw_reference.testing.raster_gradients import (
    GRADIENT_CASES,
    applies,
    check_against,
    check_gradients,
    outputs,
    run,
)
from sw_reference.testing.raster_scenes import RasterCase, draw_scene, front_camera, margin_scene, splats, with_tensors
from sw_reference.testing.rasterizer_checks import checks_for

from splatwizard_core.api import CapabilityError, ConfigError, RasterOptions, Registry, ScoreSpec, ShapeError

REFERENCE = ReferenceRasterizer()
DEPTHS = frozenset({"inverse", "accumulated", "expected", "median"})


@pytest.mark.parametrize("check", checks_for(ReferenceRasterizer.info), ids=str)
def test_fact(check):
    check(REFERENCE, "cpu")


@pytest.mark.parametrize("case", GRADIENT_CASES, ids=lambda c: c.name)
def test_gradients_are_finite_differences(case):
    assert applies(case, REFERENCE.info)
    check_gradients(REFERENCE, case)


@pytest.mark.parametrize("case", GRADIENT_CASES, ids=lambda c: c.name)
def test_float32_equals_float64(case):
    check_against(REFERENCE, REFERENCE, case)


@pytest.mark.parametrize("case", GRADIENT_CASES, ids=lambda c: c.name)
def test_values_and_gradients_equal_the_naive_loop(case):
    g, cam = margin_scene(case, 2)
    channels = case.channels if case.color == "colors" else 3
    flat = case.geometry == "surfels"
    background = torch.linspace(0.1, 0.9, channels).double()
    options = case.raster_options(alpha=True, depth=DEPTHS, background=background, normals=flat, distortion=flat)
    gradients = []
    for render in (naive_render, REFERENCE.render):
        leaves = {k: v.clone().requires_grad_() for k, v in g.tensors().items() if v.is_floating_point()}
        result = render(with_tensors(g, leaves), cam, options)
        maps = [result.image, result.alpha.reshape(1, cam.height, cam.width)]
        maps += [result.depth[m].reshape(1, cam.height, cam.width) for m in sorted(DEPTHS)]
        if case.features:
            maps.append(result.features)
        if flat:
            maps += [result.normals, result.distortion.reshape(1, cam.height, cam.width)]
        drawn = torch.cat(maps)
        weights = torch.randn(drawn.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        gradients.append([drawn.detach(), *torch.autograd.grad((drawn * weights).sum(), list(leaves.values()))])
    for a, b in zip(*gradients, strict=True):
        torch.testing.assert_close(b, a, atol=1e-10, rtol=1e-8)


def test_result_does_not_depend_on_the_tile_size():
    g, cam = margin_scene(RasterCase(n=15), 5)
    images = [ReferenceRasterizer(tile=t).render(g, cam, RasterOptions()).image for t in (4, 16, 32)]
    for image in images[1:]:
        torch.testing.assert_close(image, images[0], atol=1e-13, rtol=0)


def _trace(name):
    case = next(c for c in GRADIENT_CASES if c.name == name)
    g, cam = margin_scene(case, 1)
    return g, cam, naive_render(g, cam, case.raster_options())


def test_gradient_cases_show_what_their_names_say():
    stops = [int((p.tried & ~p.blended).sum()) for p in _trace("stop")[2].pairs]
    assert sum(stops) > 0
    clamped = [int((p.blended & (p.raw > 0.99)).sum()) for p in _trace("alpha-clamp")[2].pairs]
    assert sum(clamped) > 50
    g, cam, result = _trace("jacobian-clamp")
    t = g.means @ cam.R.T + cam.tau
    limits = 1.3 * torch.tensor(cam.tan_half_fov)
    outside = ((t[:, :2] / t[:, 2:]).abs() > limits).any(dim=1)
    assert any(bool(outside[p.index]) and int(p.blended.sum()) > 100 for p in result.pairs)
    assert all(float(p.raw.max()) < 0.2 for p in _trace("antialias-floor")[2].pairs)  # opacity 20 to 40 times 0.005
    stops = [int((p.tried & ~p.blended).sum()) for p in _trace("surfels-stop")[2].pairs]
    assert sum(stops) > 0
    clamped = [int((p.blended & (p.raw > 0.99)).sum()) for p in _trace("surfels-alpha-clamp")[2].pairs]
    assert sum(clamped) > 5
    g, cam, _ = _trace("surfels-behind")
    axes = (cam.R @ rotation_matrices(g.quats))[:, 2, :2] * g.scales
    reach = (g.means @ cam.R.T + cam.tau)[:, 2] - 3 * axes.norm(dim=1)
    assert float(reach.min()) < 0  # the 3-sigma circle of one reaches behind the camera


@pytest.mark.parametrize("clamp_grad", ["exact", "pass"])
def test_clamp_policy_equals_the_naive_loop(clamp_grad):
    case = next(c for c in GRADIENT_CASES if c.name == "alpha-clamp")
    g, cam = margin_scene(case, 1)
    gradients = []
    for render in (naive_render, REFERENCE.render):
        opacities = g.opacities.clone().requires_grad_()
        options = RasterOptions(clamp_grad=clamp_grad)
        image = render(with_tensors(g, {"opacities": opacities}), cam, options).image
        gradients += torch.autograd.grad(image.square().sum(), opacities)
    torch.testing.assert_close(gradients[1], gradients[0], atol=1e-10, rtol=1e-9)


def test_chunked_and_recomputed_pass_equals_the_direct_one(monkeypatch):
    """Small chunks, so that transmittance is carried on, with the backward pass evaluating them again."""
    case = RasterCase("chunks", n=40, width=45, height=37, color="colors", features=1, opacity=(0.5, 0.95))
    g, cam = draw_scene(case, 3)
    specs = tuple(ScoreSpec(k, k) for k in ("hits", "blend", "grad_sq", "blend_max"))
    options = RasterOptions(alpha=True, depth=DEPTHS, grad2d=True, absgrad=True, scores=specs)
    direct, direct_gradients = run(REFERENCE, g, cam, options)
    monkeypatch.setattr(compositing, "CHUNK_ELEMENTS", 2000)
    monkeypatch.setattr(compositing, "CHUNK_SPLATS", 3)
    monkeypatch.setattr(compositing, "KEEP_ELEMENTS", 0)
    chunked, chunked_gradients = run(REFERENCE, g, cam, options)
    for name, value in outputs(direct).items():
        torch.testing.assert_close(outputs(chunked)[name], value, atol=1e-12, rtol=1e-12)
    for name, value in direct_gradients.items():
        torch.testing.assert_close(chunked_gradients[name], value, atol=1e-11, rtol=1e-9)
    torch.testing.assert_close(chunked.grad2d.value, direct.grad2d.value, atol=1e-11, rtol=1e-9)
    torch.testing.assert_close(chunked.absgrad2d.value, direct.absgrad2d.value, atol=1e-11, rtol=1e-9)
    for name, value in direct.scores.items():
        torch.testing.assert_close(chunked.scores[name], value)


def test_classic_tiles_clip_at_the_square_of_three_sigma():
    """An opaque splat has alpha > 1/255 up to 3.33 sigma; the original clips it where a tile ends beyond 3 sigma."""
    g = splats([[0, 0, 4]], opacities=[1.0], scales=[0.6])
    cam = front_camera(128, 128, cx=78.0)
    options = RasterOptions(alpha=True)
    exact = REFERENCE.render(g, cam, options).alpha[0]
    classic = ReferenceRasterizer(classic_tiles=True).render(g, cam, options).alpha[0]
    profile = REFERENCE.render(g, cam, RasterOptions(alpha=True, profile="dgr-exact")).alpha[0]
    radius = int(REFERENCE.render(g, cam, options).radii[0])
    first = int((78.0 - 0.5 - radius) / 16) * 16  # left edge of the leftmost tile of the square
    assert torch.equal(classic, profile)
    assert float(classic[:, :first].max()) == 0
    assert float(exact[:, :first].max()) > 1 / 255
    kept = classic > 0
    assert torch.equal(classic[kept], exact[kept])
    assert 1 / 255 <= float(exact[~kept].max()) <= 0.0112  # exp(-4.5)


def test_dgr_profile_differentiates_the_clamped_jacobian_as_the_original():
    """The original doubles the dependence of the clamped slope on depth and keeps values equal."""
    case = next(c for c in GRADIENT_CASES if c.name == "jacobian-clamp")
    g, cam = margin_scene(case, 1)
    found = []
    for profile in ("3dgs", "dgr-exact"):
        means = g.means.clone().requires_grad_()
        image = (
            ReferenceRasterizer(classic_tiles=True)
            .render(with_tensors(g, {"means": means}), cam, RasterOptions(profile=profile))
            .image
        )
        found.append((image.detach(), torch.autograd.grad(image.square().sum(), means)[0]))
    torch.testing.assert_close(found[0][0], found[1][0], atol=1e-12, rtol=1e-12)
    t = g.means @ cam.R.T + cam.tau
    outside = ((t[:, :2] / t[:, 2:]).abs() > 1.3 * torch.tensor(cam.tan_half_fov)).any(dim=1)
    difference = (found[0][1] - found[1][1]).abs().amax(dim=1)
    assert float(difference[~outside].max()) < 1e-10
    assert float(difference[outside].max()) > 1e-4


def test_what_is_not_offered_is_refused():
    g, cam = draw_scene(RasterCase(), 0)
    with pytest.raises(CapabilityError, match="does not offer UINT8_OUT") as caught:
        REFERENCE.render(g, cam, RasterOptions(dtype_out="uint8"))
    assert caught.value.missing == {"UINT8_OUT"}
    with pytest.raises(CapabilityError, match="normals and distortion of surfels only"):
        REFERENCE.render(g, cam, RasterOptions(normals=True, distortion=True))
    with pytest.raises(CapabilityError, match="ANTIALIAS and SURFEL together"):
        REFERENCE.render(*draw_scene(RasterCase(geometry="surfels"), 0), RasterOptions(antialias=True))
    with pytest.raises(ConfigError, match="gsplat"):
        REFERENCE.render(g, cam, RasterOptions(profile="gsplat"))
    with pytest.raises(ShapeError, match="background"):
        REFERENCE.render(g, cam, RasterOptions(background=torch.zeros(4)))


def test_no_graph_is_kept_without_gradients():
    g, cam = draw_scene(RasterCase(), 0)
    g.means.requires_grad_()
    with torch.no_grad():
        result = REFERENCE.render(g, cam, RasterOptions(grad2d=True))
    assert not result.image.requires_grad
    assert result.grad2d is None


def test_screen_gradient_without_other_gradients():
    """Only the statistic is asked for: no input requires a gradient."""
    g, cam = draw_scene(RasterCase(), 0)
    result = REFERENCE.render(g, cam, RasterOptions(grad2d=True))
    result.image.square().sum().backward()
    assert float(result.grad2d.value.abs().max()) > 0


def test_declared_features_are_those_of_the_registry():
    registry = Registry("rasterizer")
    plugin.register_rasterizers(registry)
    assert registry.entry("reference").load().info.features == set(registry.entry("reference").declared["features"])


def test_the_checks_are_importable_without_pytest():
    code = """
import sys
sys.modules["pytest"] = None
from sw_reference.testing import raster_gradients, rasterizer_checks
from sw_reference.rasterizer import ReferenceRasterizer
checks = rasterizer_checks.checks_for(ReferenceRasterizer.info)
checks[0](ReferenceRasterizer(), "cpu")
print(len(checks))
"""
    done = run_python("-c", code)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) == len(checks_for(ReferenceRasterizer.info)) > 50
