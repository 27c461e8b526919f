"""What the compiled kernels promise beyond the checks that every rasterizer passes."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest
import torch
from sw_reference.rasterizer import ReferenceRasterizer
from sw_reference.testing.raster_gradients import run
from sw_reference.testing.raster_scenes import RasterCase, cast_inputs, draw_scene, front_camera, splats, with_tensors

from splatwizard_core.api import (
    SH,
    Camera,
    CapabilityError,
    ConfigError,
    Feature,
    GaussianInputs,
    RasterOptions,
    RenderResult,
    ScoreSpec,
    ShapeError,
)
from splatwizard_core.tooling import load_plugins
from sw_rasterizers.native import MODULE
from sw_rasterizers.ops import visible_radii
from sw_rasterizers.standard import StandardRasterizer

pytestmark = pytest.mark.skipif(MODULE.available() is not None, reason=str(MODULE.available()))
ALL_DEPTHS = frozenset({"inverse", "accumulated", "expected", "median"})
MANY = RasterCase("many", n=1000, width=75, height=50, spread=2.0, scale=(0.01, 0.25), degree=3)
"""Fills 5 x 4 tiles, the last ones partial, with lists longer than a stage of the kernels."""


@pytest.fixture
def threads():
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


def leaves(g: GaussianInputs) -> GaussianInputs:
    floating = {k: x.detach().clone().requires_grad_() for k, x in g.tensors().items() if x.is_floating_point()}
    return with_tensors(g, floating)


def split(g: GaussianInputs) -> GaussianInputs:
    assert g.sh is not None
    assert g.sh.dense is not None
    return replace(g, sh=SH(dc=g.sh.dense[:, :1].clone(), rest=g.sh.dense[:, 1:].clone(),
                            active_degree=g.sh.active_degree))  # fmt: skip


@pytest.mark.parametrize(
    ("form", "options"),
    [
        ("dense", RasterOptions(grad2d=True, absgrad=True)),
        ("split", RasterOptions(clamp_grad="pass", scale_modifier=1.4, eps2d=0.1)),
        ("split", RasterOptions(alpha=True, depth=ALL_DEPTHS, grad2d=True, absgrad=True, antialias=True)),
        ("dense", RasterOptions(profile="dgr-exact", grad2d=True)),
    ],
    ids=["plain", "pass", "everything", "dgr-exact"],
)
def test_many_splats_equal_the_reference_in_float64(form, options):
    g, cam = draw_scene(MANY, 3)
    g.opacities[:50] = 1.0  # the clamp of alpha is active somewhere
    if form == "split":
        g = split(g)
    options = replace(options, background=torch.rand(3, 50, 75, generator=torch.Generator().manual_seed(1)).double())
    result, gradients = run(StandardRasterizer(), g, cam, options)
    expected, expected_gradients = run(ReferenceRasterizer(), g, cam, options)
    assert torch.equal(result.radii, expected.radii)
    torch.testing.assert_close(result.image, expected.image, atol=1e-11, rtol=0)
    for mode in result.depth:
        torch.testing.assert_close(result.depth[mode], expected.depth[mode], atol=1e-9, rtol=1e-9)
    for name in ("grad2d", "absgrad2d"):
        if getattr(result, name) is not None:
            gradients[name], expected_gradients[name] = getattr(result, name).value, getattr(expected, name).value
    for name, value in gradients.items():
        wanted = expected_gradients[name]
        assert float((value - wanted).norm()) <= 1e-8 * float(wanted.norm()), name
    assert result.stats.n_visible == expected.stats.n_visible


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_results_are_bit_equal_for_any_number_of_threads(threads, dtype):
    g, cam = draw_scene(replace(MANY, n=6000), 4, dtype)
    options = RasterOptions(alpha=True, depth=ALL_DEPTHS, grad2d=True, absgrad=True)
    plain = RasterOptions(grad2d=True)
    found = []
    for count in (1, 2, 3):
        threads(count)
        for opt in (options, plain):
            result, gradients = run(StandardRasterizer(), g, cam, opt)
            found.append([result.image, result.radii, result.grad2d.value, *result.depth.values(), *gradients.values()])
    for i in (0, 1):
        for other in (found[i + 2], found[i + 4]):
            assert all(torch.equal(a, b) for a, b in zip(found[i], other, strict=True))


def test_python_threads_may_draw_at_once():
    g, cam = draw_scene(replace(MANY, n=20_000, scale=(0.002, 0.02)), 4, torch.float32)
    scenes = [with_tensors(g, {"means": g.means + 0.05 * k}) for k in range(4)]

    def step(inputs: GaussianInputs) -> list[torch.Tensor]:
        result, gradients = run(StandardRasterizer(), inputs, cam, RasterOptions(grad2d=True))
        return [result.image, result.grad2d.value, *gradients.values()]

    alone = [step(inputs) for inputs in scenes]
    assert not torch.equal(alone[0][0], alone[1][0])
    with ThreadPoolExecutor(4) as pool:
        for _ in range(3):
            for found, expected in zip(pool.map(step, scenes), alone, strict=True):
                assert all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))


def test_features_may_leave_the_geometry_alone():
    g, cam = draw_scene(replace(MANY, n=200, features=2), 5)
    for detach in (False, True):
        options = RasterOptions(features_detach_geometry=detach)
        _, gradients = run(StandardRasterizer(), g, cam, options)
        _, expected = run(ReferenceRasterizer(), g, cam, options)
        for name, value in gradients.items():
            assert float((value - expected[name]).norm()) <= 1e-8 * float(expected[name].norm()), name


def test_gradients_only_where_they_are_asked_for():
    g, cam = draw_scene(replace(MANY, n=300), 6, torch.float32)
    g = split(g)
    assert g.sh is not None
    g.opacities.requires_grad_()
    result = StandardRasterizer().render(g, cam, RasterOptions(grad2d=True))
    result.image.sum().backward()
    assert g.opacities.grad is not None
    assert [x.grad for x in (g.means, g.scales, g.quats, g.sh.dc, g.sh.rest)] == [None] * 5
    assert float(result.grad2d.value.abs().max()) > 0


def test_no_state_is_kept_without_gradient():
    g, cam = draw_scene(replace(MANY, n=300), 6, torch.float32)
    g = leaves(g)
    with torch.no_grad():
        result = StandardRasterizer().render(g, cam, RasterOptions(grad2d=True))
    assert result.image.grad_fn is None
    assert result.grad2d is None
    assert StandardRasterizer().render(g, cam, RasterOptions()).image.grad_fn is not None


def test_statistics_need_no_input_with_gradient():
    g, cam = draw_scene(replace(MANY, n=300), 6, torch.float32)
    result = StandardRasterizer().render(g, cam, RasterOptions(grad2d=True))
    with pytest.raises(RuntimeError, match="after backward"):
        _ = result.grad2d.value
    result.image.sum().backward()
    expected = ReferenceRasterizer().render(g, cam, RasterOptions(grad2d=True))
    expected.image.sum().backward()
    torch.testing.assert_close(result.grad2d.value, expected.grad2d.value, atol=1e-3, rtol=1e-3)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_inactive_bands_and_culled_rows_get_exactly_zero(degree):
    g, cam = draw_scene(replace(MANY, n=3000, active_degree=degree, spread=6.0), 7, torch.float32)
    for form in (leaves(g), leaves(split(g))):
        result = StandardRasterizer().render(form, cam, RasterOptions())
        result.image.sum().backward()
        sh = form.sh
        gradient = sh.dense.grad if sh.dense is not None else torch.cat([sh.dc.grad, sh.rest.grad], dim=1)
        basis = (degree + 1) ** 2
        culled = ~result.visible
        assert 0 < int(culled.sum()) < 3000
        assert int(torch.count_nonzero(gradient[:, basis:])) == 0
        assert int(torch.count_nonzero(gradient[:, :basis])) > 0
        for x in (gradient, form.means.grad, form.scales.grad, form.quats.grad, form.opacities.grad):
            assert int(torch.count_nonzero(x[culled])) == 0


def test_tight_tiles_are_never_more_than_the_classic_ones():
    for seed in range(5):
        g, cam = draw_scene(replace(MANY, n=500, scale=(0.001, 0.5)), seed, torch.float32)
        tight = StandardRasterizer().render(g, cam, RasterOptions()).stats
        classic = StandardRasterizer().render(g, cam, RasterOptions(profile="dgr-exact")).stats
        assert 0 < tight.n_pairs < classic.n_pairs
        assert tight.n_visible == classic.n_visible


def test_counting_mode_counts_what_the_reference_counts():
    g, cam = draw_scene(replace(MANY, n=400), 8)
    ours = StandardRasterizer(count=True).render(g, cam, RasterOptions()).stats
    reference = ReferenceRasterizer().render(g, cam, RasterOptions()).stats
    assert ours.n_blended == reference.n_blended
    assert ours.n_blended < ours.n_evaluated <= reference.n_evaluated
    assert StandardRasterizer().render(g, cam, RasterOptions()).stats.n_blended is None


def test_a_hundred_thousand_splats_in_one_tile(threads):
    threads(2)
    n = 100_000
    g = splats([[0, 0, 4]] * n, opacities=[0.3] * n, scales=[0.5] * n)
    g.means[:, 2] += 1e-5 * torch.arange(n).flip(0)
    g = leaves(g)
    result = StandardRasterizer().render(g, front_camera(16, 16), RasterOptions())
    result.image.sum().backward()
    assert result.stats.n_pairs == n
    assert bool(torch.isfinite(result.image).all())
    assert bool(torch.isfinite(g.means.grad).all())
    assert float(g.colors.grad[-1].min()) > 0
    assert float(g.colors.grad[0].abs().max()) == 0


def test_later_steps_do_not_touch_gradients_that_are_still_held():
    """Large buffers are recycled; one that somebody holds must not be."""
    g, cam = draw_scene(replace(MANY, n=40_000, scale=(0.002, 0.02)), 9, torch.float32)
    g = leaves(g)
    assert g.sh is not None
    first = StandardRasterizer().render(g, cam, RasterOptions())
    first.image.sum().backward()
    held, copy = g.sh.dense.grad, g.sh.dense.grad.clone()
    assert held.numel() * 4 > 1 << 20
    image = first.image.detach().clone()
    for _ in range(3):
        for x in g.tensors().values():
            x.grad = None
        StandardRasterizer().render(g, cam, RasterOptions()).image.square().sum().backward()
    assert torch.equal(held, copy)
    assert torch.equal(first.image, image)


def test_five_hundred_splats_learn_a_picture():
    generator = torch.Generator().manual_seed(2)
    n = 500
    ys, xs = torch.meshgrid(torch.linspace(0, 1, 64), torch.linspace(0, 1, 64), indexing="ij")
    target = torch.stack([xs, ys, (6.3 * (xs + ys)).sin() * 0.5 + 0.5])
    raw = {
        "means": torch.cat([torch.rand(n, 2, generator=generator) * 4 - 2, torch.full((n, 1), 4.0)], dim=1),
        "opacities": torch.zeros(n),
        "scales": torch.full((n, 3), -2.5),
        "quats": torch.randn(n, 4, generator=generator),
        "colors": torch.rand(n, 3, generator=generator),
    }
    parameters = {name: x.requires_grad_() for name, x in raw.items()}
    optimizer = torch.optim.Adam(parameters.values(), lr=0.02)
    losses = []
    for _ in range(200):
        g = GaussianInputs(
            raw["means"], raw["opacities"].sigmoid(), raw["scales"].exp(), raw["quats"], colors=raw["colors"]
        )
        loss = (StandardRasterizer().render(g, front_camera(), RasterOptions()).image - target).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < losses[0] / 10


def test_what_is_not_offered_is_refused():
    rasterizer, (g, cam) = StandardRasterizer(), draw_scene(replace(MANY, n=5), 1, torch.float32)
    for options, missing in (
        (RasterOptions(normals=True), "NORMALS"),
        (RasterOptions(dtype_out="uint8"), "UINT8_OUT"),
    ):
        with pytest.raises(CapabilityError, match=missing):
            rasterizer.render(g, cam, options)
    with pytest.raises(CapabilityError, match="NORMALS"):
        rasterizer.accumulate(g, [cam], RasterOptions(scores=(ScoreSpec("s", "hits"),), normals=True))
    with pytest.raises(ConfigError, match="gsplat"):
        rasterizer.render(g, cam, RasterOptions(profile="gsplat"))
    with pytest.raises(ShapeError, match="background"):
        rasterizer.render(g, cam, RasterOptions(background=torch.zeros(4)))
    with pytest.raises(ShapeError, match="dtype"):
        rasterizer.render(replace(g, opacities=g.opacities.double()), cam, RasterOptions())
    indexed, cam = draw_scene(RasterCase(geometry="indexed"), 1, torch.float32)
    with pytest.raises(CapabilityError, match="INDEXED_GEOM"):
        rasterizer.render(indexed, cam, RasterOptions())
    with pytest.raises(CapabilityError, match="INDEXED_GEOM"):
        rasterizer.visible_filter(indexed, cam)
    surfels = replace(g, scales=g.scales[:, :2].contiguous())
    with pytest.raises(CapabilityError, match="SURFEL"):
        rasterizer.render(surfels, cam, RasterOptions())
    with pytest.raises(CapabilityError, match="SURFEL"):
        rasterizer.visible_filter(surfels, cam)
    with pytest.raises(RuntimeError, match="scales must be"):  # the op itself, too, reads no further than there is
        visible_radii(g.means, surfels.scales, g.quats, None, None, cam)
    with pytest.raises(ShapeError, match="no channel"):
        rasterizer.render(replace(g, sh=None, colors=torch.zeros(5, 0)), cam, RasterOptions())
    with pytest.raises(CapabilityError, match="meta"):
        rasterizer.render(cast_inputs(g, device="meta"), cam, RasterOptions())


def test_registry_entry_declares_what_the_class_offers():
    entry = load_plugins().rasterizers.entry("standard")
    assert entry.load() is StandardRasterizer
    assert {Feature[name].name for name in entry.declared["features"]} == StandardRasterizer.info.features
    assert StandardRasterizer.info.speed > ReferenceRasterizer.info.speed


def test_opacity_gradients_of_fragments_are_those_of_autograd_pixel_by_pixel():
    dtype = torch.float32
    g, camera = fragment_scene(dtype)
    truth = torch.rand(3, 16, 16, generator=torch.Generator().manual_seed(2)).to(dtype)

    def pixels(**asked: bool) -> tuple[torch.Tensor, RenderResult]:
        result = StandardRasterizer().render(g, camera.to(dtype=dtype), RasterOptions(**asked))
        return (result.image - truth).square().mean(dim=0) / (16 * 16), result

    parts, _ = pixels()
    expected = torch.zeros(len(g), 2, dtype=dtype)
    for part in parts.flatten():
        (gradient,) = torch.autograd.grad(part, g.opacities, retain_graph=True)
        gradient = gradient * g.opacities.detach()
        expected += torch.stack([gradient.square(), (gradient != 0).to(dtype)], dim=1)
    parts, result = pixels(fragment_grad=True, grad2d=True)
    parts.sum().backward()
    assert result.fragment_grad is not None
    assert result.absgrad2d is None
    assert torch.equal(result.fragment_grad.value[:, 1], expected[:, 1])
    assert torch.allclose(result.fragment_grad.value[:, 0], expected[:, 0], rtol=1e-3, atol=0)


def fragment_scene(dtype: torch.dtype) -> tuple[GaussianInputs, Camera]:
    """Twenty Gaussians in front of a camera of 16 x 16 pixels; opacities require a gradient."""
    r = torch.Generator().manual_seed(1)

    def draw(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=r, dtype=torch.float64).to(dtype)

    means = torch.cat([2 * draw(20, 2) - 1, 2 * draw(20, 1) + 3], dim=1)
    quats = torch.nn.functional.normalize(draw(20, 4) - 0.5, dim=1)
    opacities = (0.9 * draw(20) + 0.05).requires_grad_()
    g = GaussianInputs(means, opacities, 0.3 * draw(20, 3) + 0.05, quats, colors=draw(20, 3))
    return g, Camera(16, 16, 20.0, 20.0, 8.0, 8.0, torch.eye(3), torch.zeros(3))


def test_opacity_gradients_and_absolute_gradients_exclude_each_other():
    g, camera = fragment_scene(torch.float32)
    with pytest.raises(ConfigError, match="ask for one of them"):
        StandardRasterizer().render(g, camera, RasterOptions(fragment_grad=True, absgrad=True))
