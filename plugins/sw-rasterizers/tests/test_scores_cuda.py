"""Scores and Fisher blocks on a GPU: the same facts as on the CPU, and agreement with the CPU's kernels."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from sw_reference.rasterizer import ReferenceRasterizer
from sw_reference.testing.raster_scenes import RasterCase, cast_inputs, draw_scene, margin_scene, with_tensors

from splatwizard_core.api import SH, RasterOptions, ScoreSpec
from splatwizard_core.tooling import NegotiatedRasterizer, load_plugins
from sw_rasterizers import scoring
from sw_rasterizers.native import unavailable_on_cuda
from sw_rasterizers.standard import StandardRasterizer

pytestmark = [
    pytest.mark.cuda,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU"),
    pytest.mark.skipif(unavailable_on_cuda() is not None, reason=str(unavailable_on_cuda())),
]
MANY = RasterCase("many", n=3000, width=203, height=150, spread=2.0, scale=(0.01, 0.25), degree=3)
"""Fills 13 x 10 tiles, the last ones partial, with lists longer than a stage of the kernels."""
FEW = RasterCase("few", n=6, width=18, height=7, spread=0.7, scale=(0.2, 0.6), opacity=(0.5, 0.98))
ALL = [ScoreSpec(kind, kind) for kind in scoring.KINDS]
TESTED = [
    ScoreSpec(f"{kind} tested", kind, rule="tested", gamma=0.3)
    for kind in scoring.KINDS
    if kind not in ("grad_sq", "removal")
]


def relative(found, expected):
    return float((found.cpu().double() - expected.double()).norm() / expected.double().norm().clamp(min=1e-30))


@pytest.mark.parametrize("changes", [{}, {"antialias": True}, {"profile": "dgr-exact"}], ids=lambda o: str(*o.values()))
@pytest.mark.parametrize("specs", [ALL, TESTED], ids=["blended", "tested"])
def test_scores_of_many_splats_equal_the_kernels_of_the_cpu(specs, changes):
    """A cut may flip on rounding: a pair in thousands more or less."""
    g, cam = draw_scene(MANY, 3, torch.float32)
    g.opacities[:50] = 1.0  # the clamp of alpha is active somewhere
    generator = torch.Generator().manual_seed(1)
    weight = torch.rand(cam.height, cam.width, generator=generator)
    specs = [
        *specs,
        ScoreSpec("weighted", "blend", weight),
        ScoreSpec("masked", "hits", weight > 0.5),
        ScoreSpec("squares", "grad_sq", weight),
        ScoreSpec("cost", "removal", residual=torch.rand(3, cam.height, cam.width, generator=generator) - 0.5),
    ]
    background = torch.rand(3, cam.height, cam.width, generator=generator)
    opt = RasterOptions(scores=tuple(specs), background=background, **changes)
    expected = StandardRasterizer().render(g, cam, opt).scores
    found = StandardRasterizer().render(cast_inputs(g, device="cuda"), cam.to("cuda"), opt).scores
    assert list(found) == list(expected)
    for name, value in expected.items():
        assert found[name].dtype == value.dtype
        assert relative(found[name], value) <= 1e-3, name
        assert float(value.abs().max()) > 0, name


@pytest.mark.parametrize("form", ["sh", "split", "degree 1", "colors", "background"])
@pytest.mark.parametrize("policy", ["exact", "pass"])
def test_fisher_blocks_of_many_splats_equal_the_kernels_of_the_cpu(form, policy):
    case = {"degree 1": {"active_degree": 1}, "colors": {"color": "colors"}}.get(form, {"sh_scale": 0.4})
    g, cam = draw_scene(replace(MANY, **case), 5, torch.float32)
    if form == "split":
        g = replace(g, sh=SH(dc=g.sh.dense[:, :1].clone(), rest=g.sh.dense[:, 1:].clone()))
    background = torch.tensor([0.1, 0.5, 0.9]) if form == "background" else None
    opt = RasterOptions(fisher=True, clamp_grad=policy, background=background, scale_modifier=1.2)
    expected = StandardRasterizer().accumulate(g, [cam], opt).fisher
    found = StandardRasterizer().accumulate(cast_inputs(g, device="cuda"), [cam], opt).fisher.cpu()
    assert relative(found, expected) <= 1e-3
    diagonal = [0, 6, 11, 15, 18, 20]
    scale = expected[:, diagonal].amax(dim=1, keepdim=True).clamp(min=1e-20)
    close = ((found - expected) / scale).abs().amax(dim=1) <= 1e-2
    assert float(close.float().mean()) >= 0.999  # Gaussian by Gaussian, whatever its size; but for flipped cuts
    assert bool(((expected == 0) == (found == 0)).float().mean() > 0.999)


def test_fisher_blocks_equal_brute_force():
    g, cam = margin_scene(FEW, 2)
    opt = RasterOptions(fisher=True, background=torch.tensor([0.1, 0.5, 0.9]))
    expected = ReferenceRasterizer().render(g, cam, opt).fisher
    found = StandardRasterizer().render(cast_inputs(g, torch.float32, "cuda"), cam, opt).fisher.cpu()
    scale = expected[:, [0, 6, 11, 15, 18, 20]].amax(dim=1, keepdim=True).clamp(min=1e-30)
    torch.testing.assert_close(found / scale, expected / scale, rtol=1e-3, atol=1e-4)


def test_blend_scores_sum_to_the_covered_light_and_hits_are_the_blended_pairs():
    g, cam = draw_scene(MANY, 5, torch.float32)
    moved = cast_inputs(g, device="cuda")
    opt = RasterOptions(alpha=True, scores=(ScoreSpec("b", "blend"), ScoreSpec("h", "hits")))
    result = StandardRasterizer(count=True).render(moved, cam, opt)
    torch.testing.assert_close(result.scores["b"].double().sum(), result.alpha.double().sum(), rtol=1e-5, atol=0)
    assert int(result.scores["h"].sum()) == result.stats.n_blended
    again = StandardRasterizer().accumulate(moved, [cam, cam], opt).scores
    assert torch.equal(again["h"], 2 * result.scores["h"])  # no count is ever lost


def test_no_gradient_and_nothing_to_score():
    g, cam = draw_scene(MANY, 1, torch.float32)
    moved = cast_inputs(g, device="cuda")
    leaves = with_tensors(moved, {k: x.requires_grad_() for k, x in moved.tensors().items() if x.is_floating_point()})
    opt = RasterOptions(scores=tuple(ALL), fisher=True)
    total = StandardRasterizer().accumulate(leaves, [cam, cam.resized(40, 33)], opt)
    assert all(x.grad is None for x in leaves.tensors().values())
    assert not any(x.requires_grad for x in [*total.scores.values(), total.fisher])
    none = with_tensors(moved, {k: x.detach()[:0] for k, x in moved.tensors().items()})
    assert StandardRasterizer().accumulate(none, [cam], opt).fisher.shape == (0, 21)
    behind = with_tensors(moved, {"means": moved.means.detach() - 100 * cam.R[2].cuda()})
    empty = StandardRasterizer().accumulate(behind, [cam], opt)
    assert all(float(x.abs().sum()) == 0 for x in [*empty.scores.values(), empty.fisher])


def test_scores_are_formed_by_the_rasterizer_that_draws():
    rasterizer = NegotiatedRasterizer(load_plugins(), device="cuda")
    g, cam = draw_scene(FEW, 1, torch.float32)
    moved = cast_inputs(g, device="cuda")
    for spec in ("opacity_T", "grad_sq", "removal", "blend"):
        rasterizer.accumulate(moved, [cam], RasterOptions(scores=(ScoreSpec("s", spec),)))
    rasterizer.accumulate(moved, [cam], RasterOptions(fisher=True))
    assert set(rasterizer.choices.values()) == {"standard"}
