"""The scoring rasterizers on the CPU: scores and Fisher blocks against the reference, identities, bit equality."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from sw_reference.rasterizer import ReferenceRasterizer
from sw_reference.testing.raster_scenes import (
    RasterCase,
    cast_inputs,
    draw_scene,
    front_camera,
    margin_scene,
    splats,
    with_tensors,
)

from splatwizard_core.api import SH, Camera, CapabilityError, ConfigError, RasterOptions, ScoreSpec
from splatwizard_core.tooling import NegotiatedRasterizer, load_plugins
from sw_rasterizers import scoring
from sw_rasterizers.native import MODULE
from sw_rasterizers.standard import StandardRasterizer

pytestmark = pytest.mark.skipif(MODULE.available() is not None, reason=str(MODULE.available()))
MANY = RasterCase("many", n=1000, width=75, height=50, spread=2.0, scale=(0.01, 0.25), degree=3)
"""Fills 5 x 4 tiles, the last ones partial, with lists longer than a stage of the kernels."""
FEW = RasterCase("few", n=6, width=18, height=2, spread=0.7, scale=(0.2, 0.6), opacity=(0.5, 0.98))
"""Small enough for the oracle's Fisher blocks: a pass of autograd for each of 108 values."""
ALL = [ScoreSpec(kind, kind) for kind in scoring.KINDS]
TESTED = [
    ScoreSpec(f"{kind} tested", kind, rule="tested", gamma=0.3)
    for kind in scoring.KINDS
    if kind not in ("grad_sq", "removal")
]


@pytest.fixture
def threads():
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


def other_camera(width, height):
    eye, target, up = torch.tensor([[3.0, 0.5, -1.5], [0.0, 0.1, 0.0], [0.1, -1.0, 0.0]])
    return Camera.look_at(eye, target, up, width=width, height=height, fov_x=0.8)


@pytest.mark.parametrize("options", [{}, {"antialias": True}, {"profile": "dgr-exact"}], ids=lambda o: str(*o.values()))
@pytest.mark.parametrize("specs", [ALL, TESTED], ids=["blended", "tested"])
def test_scores_of_many_splats_equal_the_reference_in_float64(specs, options):
    g, cam = draw_scene(MANY, 3)
    g.opacities[:50] = 1.0  # the clamp of alpha is active somewhere
    generator = torch.Generator().manual_seed(1)
    weight = torch.rand(50, 75, generator=generator, dtype=torch.float64)
    specs = [*specs, replace(specs[3], name="weighted", pixel_weight=weight), replace(specs[0], name="masked",
             pixel_weight=weight > 0.5), replace(ScoreSpec("g", "grad_sq"), pixel_weight=weight)]  # fmt: skip
    residual = torch.rand(3, 50, 75, generator=generator, dtype=torch.float64) - 0.5
    specs += [
        ScoreSpec("cost", "removal", residual=residual),
        ScoreSpec("cost of half", "removal", residual=residual / 2),
    ]
    background = torch.rand(3, 50, 75, generator=generator, dtype=torch.float64)
    opt = RasterOptions(scores=tuple(specs), background=background, **options)
    found, expected = (r.render(g, cam, opt) for r in (StandardRasterizer(), ReferenceRasterizer()))
    torch.testing.assert_close(found.image, expected.image, atol=1e-11, rtol=0)
    assert list(found.scores) == list(expected.scores)
    for name, value in expected.scores.items():
        torch.testing.assert_close(found.scores[name], value, rtol=1e-6, atol=1e-6, msg=name)
        assert float(value.abs().max()) > 0


def test_float32_scores_are_close_to_float64():
    g, cam = draw_scene(MANY, 4)
    opt = RasterOptions(scores=(*ALL, *TESTED))
    exact = StandardRasterizer().render(g, cam, opt).scores
    single = StandardRasterizer().render(cast_inputs(g, torch.float32), cam, opt).scores
    for name, value in exact.items():
        error = float((single[name].double() - value.double()).norm() / value.double().norm())
        assert error <= 1e-3, f"{name}: relative error {error:.3g}"  # a cut may flip on rounding


def test_blend_scores_sum_to_the_covered_light_and_hits_are_the_blended_pairs():
    g, cam = draw_scene(MANY, 5, torch.float32)
    opt = RasterOptions(alpha=True, scores=(ScoreSpec("b", "blend"), ScoreSpec("h", "hits")))
    result = StandardRasterizer(count=True).render(g, cam, opt)
    torch.testing.assert_close(result.scores["b"].double().sum(), result.alpha.double().sum(), rtol=1e-5, atol=0)
    assert int(result.scores["h"].sum()) == result.stats.n_blended


@pytest.mark.parametrize(
    ("form", "policy"),
    [
        ("sh", "exact"),
        ("sh", "pass"),
        *((form, "pass") for form in ("degree 0", "clamped", "outside", "split", "colors")),
    ],
)
def test_fisher_blocks_equal_brute_force(form, policy):
    changes = {"degree 0": {"active_degree": 0}, "clamped": {"sh_scale": 0.6}, "colors": {"color": "colors"},
               "outside": {"spread": 3.5, "n": 14}}.get(form, {})  # fmt: skip
    g, cam = margin_scene(replace(FEW, **changes), 2)
    if form == "split":
        g = replace(g, sh=SH(dc=g.sh.dense[:, :1].clone(), rest=g.sh.dense[:, 1:].clone()))
    if form == "sh":
        g.opacities[0] = 1.0
    background = torch.tensor([0.1, 0.5, 0.9], dtype=torch.float64)
    opt = RasterOptions(fisher=True, background=background, clamp_grad=policy, scale_modifier=1.2)
    found, expected = (r.render(g, cam, opt).fisher for r in (StandardRasterizer(), ReferenceRasterizer()))
    assert found.dtype == torch.float32
    assert int((expected.abs().amax(dim=1) > 0).sum()) >= 3
    scale = expected[:, [0, 6, 11, 15, 18, 20]].amax(dim=1, keepdim=True)  # the diagonal
    torch.testing.assert_close(found / scale.clamp(min=1e-30), expected / scale.clamp(min=1e-30), rtol=1e-5, atol=1e-6)
    single = StandardRasterizer().render(cast_inputs(g, torch.float32), cam, opt).fisher
    torch.testing.assert_close(single / scale.clamp(min=1e-30), expected / scale.clamp(min=1e-30), rtol=1e-3, atol=1e-4)


def unpack(fisher):
    full = torch.zeros(len(fisher), 6, 6, dtype=torch.float64)
    first, second = torch.triu_indices(6, 6)
    full[:, first, second] = full[:, second, first] = fisher.double()
    return full


def test_fisher_blocks_are_positive_semidefinite_and_grow_with_views():
    g, cam = draw_scene(MANY, 6)
    second = other_camera(75, 50).to(dtype=torch.float64)
    rasterizer, opt = StandardRasterizer(), RasterOptions(fisher=True, clamp_grad="pass")
    one = unpack(rasterizer.accumulate(g, [cam], opt).fisher)
    two = unpack(rasterizer.accumulate(g, [cam, second], opt).fisher)
    for blocks in (one, two, two - one):
        values = torch.linalg.eigvalsh(blocks)
        assert bool((values[:, 0] >= -1e-6 * two.abs().amax(dim=(1, 2)).clamp(min=1e-30)).all())
    culled = rasterizer.render(g, cam, opt).radii == 0
    assert bool(culled.any())
    assert float(one[culled].abs().max()) == 0


def test_sums_over_views_are_those_of_the_views_and_leave_gradients_alone():
    g, cam = draw_scene(MANY, 7, torch.float32)
    g = with_tensors(g, {k: x.requires_grad_() for k, x in g.tensors().items() if x.is_floating_point()})
    second = other_camera(40, 33)
    rasterizer, opt = StandardRasterizer(), RasterOptions(scores=tuple(ALL), fisher=True)
    with torch.no_grad():
        views = [rasterizer.render(g, c, opt) for c in (cam, second)]
    total = rasterizer.accumulate(g, iter([cam, second]), opt)
    assert all(x.grad is None for x in g.tensors().values())
    for name, value in total.scores.items():
        assert not value.requires_grad
        a, b = (v.scores[name] for v in views)
        torch.testing.assert_close(value, torch.maximum(a, b) if name == "blend_max" else a + b)
    torch.testing.assert_close(total.fisher, views[0].fisher + views[1].fisher)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_bit_equal_for_any_number_of_threads(threads, dtype):
    g, cam = draw_scene(replace(MANY, n=6000), 4, dtype)
    opt = RasterOptions(scores=(*ALL, *TESTED), fisher=True)
    found = []
    for count in (1, 2, 3):
        threads(count)
        total = StandardRasterizer().accumulate(g, [cam, cam], opt)
        found.append([*total.scores.values(), total.fisher])
    for other in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], other, strict=True))


def test_closed_forms_of_one_gaussian():
    """All pixels of one splat see the same dI/dg = o (col - bg): LightGaussian's and Speedy-Splat's own examples."""
    cam = front_camera(32, 32)
    g = splats([[0.0, 0.0, 4.0]], scales=[0.3], opacities=[0.6], colors=torch.tensor([[0.9, 0.2, 0.4]]))
    for background, expected in (((0.0, 0.0, 0.0), 1.5), ((0.9, 0.2, 0.4), 0.0), ((0.8, 0.3, 0.4), 0.0)):
        opt = RasterOptions(background=torch.tensor(background), scores=tuple(ALL))
        scores = StandardRasterizer().render(g, cam, opt).scores
        hits = int(scores["hits"])
        assert hits > 100
        assert float(scores["opacity_T"]) == pytest.approx(0.6 * hits, rel=1e-6)
        assert float(scores["grad_sq"]) == pytest.approx(hits * (0.6 * expected) ** 2, rel=1e-4, abs=1e-9)


def test_nothing_to_score():
    g, cam = draw_scene(MANY, 1, torch.float32)
    opt = RasterOptions(scores=tuple(ALL), fisher=True)
    none = with_tensors(g, {k: x[:0] for k, x in g.tensors().items()})
    assert StandardRasterizer().accumulate(none, [cam], opt).fisher.shape == (0, 21)
    behind = with_tensors(g, {"means": g.means - 100 * cam.R[2]})
    total = StandardRasterizer().accumulate(behind, [cam], opt)
    assert all(float(x.abs().sum()) == 0 for x in [*total.scores.values(), total.fisher])
    assert StandardRasterizer().accumulate(g, [], opt).scores["hits"].shape == (1000,)


def test_requests_that_make_no_sense_are_refused():
    g, cam = draw_scene(replace(MANY, n=5), 1, torch.float32)
    for spec in (ScoreSpec("a", "hits", rule="maybe"), ScoreSpec("a", "grad_sq", rule="tested"),
                 ScoreSpec("a", "removal", rule="tested"), ScoreSpec("a", "removal", torch.ones(50, 75)),
                 ScoreSpec("a", "removal", residual=torch.ones(3, 5, 5)),
                 ScoreSpec("a", "hits", residual=torch.ones(3, 50, 75)),
                 ScoreSpec("a", "blend", torch.ones(3, 3))):  # fmt: skip
        for rasterizer in (StandardRasterizer(), ReferenceRasterizer()):
            with pytest.raises(ConfigError, match="score 'a'"):
                rasterizer.accumulate(g, [cam], RasterOptions(scores=(spec,)))
    with pytest.raises(ConfigError, match="one name"):
        StandardRasterizer().render(g, cam, RasterOptions(scores=(ScoreSpec("a", "hits"), ScoreSpec("a", "blend"))))
    with pytest.raises(CapabilityError, match="ANTIALIAS and FISHER"):
        StandardRasterizer().render(g, cam, RasterOptions(fisher=True, antialias=True))
    many = tuple(ScoreSpec(str(k), "hits") for k in range(33))
    with pytest.raises(CapabilityError, match="at most 32"):
        StandardRasterizer().accumulate(g, [cam], RasterOptions(scores=many))


@pytest.mark.parametrize(
    ("specs", "changes", "name"),
    [
        (("hits", "gamma"), {"depth": frozenset({"median"})}, "standard"),
        (("grad_sq",), {"fisher": True}, "standard"),
        ((), {"fisher": True, "antialias": True}, "reference"),
    ],
)
def test_each_request_finds_its_rasterizer(specs, changes, name):
    rasterizer = NegotiatedRasterizer(load_plugins(), device="cpu")
    g, cam = draw_scene(replace(FEW, width=5, height=4), 1, torch.float32)
    rasterizer.render(g, cam, RasterOptions(scores=tuple(ScoreSpec(k, k) for k in specs), **changes))
    assert set(rasterizer.choices.values()) == {name}


def test_codebooks_are_gathered_in_front_of_scores():
    """MesonGS' request: a codebook of the higher coefficients beside its importance."""
    g, cam = draw_scene(replace(FEW, color="indexed"), 1, torch.float32)
    rasterizer = NegotiatedRasterizer(load_plugins(), device="cpu")
    opt = RasterOptions(scores=(ScoreSpec("w", "blend"),))
    found = rasterizer.accumulate(g, [cam], opt).scores["w"]
    assert rasterizer.choices == {"INDEXED_SH+SCORE_BLEND": "standard"}
    torch.testing.assert_close(found, ReferenceRasterizer().accumulate(g, [cam], opt).scores["w"])
