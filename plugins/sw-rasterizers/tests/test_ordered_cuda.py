"""Sums in one order: where torch is asked for deterministic algorithms, equal calls on a GPU give equal bits."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from sw_reference.testing.raster_gradients import run
from sw_reference.testing.raster_scenes import RasterCase, cast_inputs, draw_scene

from splatwizard_core.api import (
    SH,
    CapabilityError,
    Feature,
    GaussianInputs,
    RasterizerInfo,
    RasterOptions,
    ScoreSpec,
)
from splatwizard_core.base.random_states import seeded
from sw_rasterizers import plugin
from sw_rasterizers.native import unavailable_on_cuda
from sw_rasterizers.scoring import KINDS
from sw_rasterizers.standard import StandardRasterizer
from sw_rasterizers.surfel import SurfelRasterizer
from sw_rasterizers.variants import IndexedRasterizer

ON_GPU = [
    pytest.mark.cuda,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU"),
    pytest.mark.skipif(unavailable_on_cuda() is not None, reason=str(unavailable_on_cuda())),
]
MANY = RasterCase("many", n=6000, width=203, height=150, spread=2.0, scale=(0.01, 0.25), degree=3)
"""Thousands that overlap: every tile's list holds hundreds, and the large ones lie in most of 130 tiles."""
ALL_DEPTHS = frozenset({"inverse", "accumulated", "expected", "median"})
CASES = {
    "plain": (RasterOptions(grad2d=True), {}),
    "absgrad": (RasterOptions(absgrad=True, alpha=True), {}),
    "depths": (RasterOptions(alpha=True, depth=ALL_DEPTHS, grad2d=True, absgrad=True), {}),
    "long": (  # lists of 2,000 to 5,000, whose pieces any block may take
        RasterOptions(grad2d=True),
        {"n": 20_000, "width": 70, "height": 50, "spread": 1.0, "scale": (0.02, 0.3), "opacity": (0.005, 0.05)},
    ),
    "large": (RasterOptions(grad2d=True), {"width": 900, "height": 900}),  # whole lists: 3,249 tiles
    "fragments": (RasterOptions(grad2d=True, fragment_grad=True), {}),
    "features": (RasterOptions(), {"features": 11}),
    "dgr-exact": (RasterOptions(profile="dgr-exact", grad2d=True), {}),
}


def drawn(name: str):
    if name == "codebooks":
        return drawn_from_codebooks()
    if name == "scores":
        return scores()
    if name.startswith("surfels"):
        return drawn_surfels(maps=name == "surfels with maps")
    options, changes = CASES[name]
    g, cam = draw_scene(replace(MANY, **changes), 3, torch.float32)
    g = cast_inputs(g, torch.float32, "cuda")
    if g.sh is not None and name == "plain":  # in two tensors, as models hold them
        sh = g.sh.dense
        g = replace(g, sh=SH(dc=sh[:, :1].clone(), rest=sh[:, 1:].clone(), active_degree=g.sh.active_degree))
    result, gradients = run(StandardRasterizer(), g, cam, options)
    found = {"image": result.image.detach(), **gradients}
    for which in ("grad2d", "absgrad2d", "fragment_grad"):
        if getattr(result, which) is not None:
            found[which] = getattr(result, which).value
    return found


def drawn_from_codebooks():
    """A few hundred rows of shapes and of colours that thousands share."""
    g, cam = draw_scene(MANY, 3, torch.float32)
    g = cast_inputs(g, torch.float32, "cuda")
    assert g.sh is not None
    assert g.scales is not None
    assert g.quats is not None
    assert g.sh.dense is not None
    rows = torch.arange(len(g), device="cuda") % 300
    leaves = {
        "scales": g.scales[:300].clone(), "quats": g.quats[:300].clone(), "codebook": g.sh.dense[:300].clone(),
        "scale_factors": torch.rand(len(g), device="cuda", generator=torch.Generator("cuda").manual_seed(1)) + 0.5,
        "means": g.means.clone(), "opacities": g.opacities.clone(),
    }  # fmt: skip
    for leaf in leaves.values():
        leaf.requires_grad_()
    shared = GaussianInputs(
        leaves["means"], leaves["opacities"], leaves["scales"], leaves["quats"], geom_indices=rows,
        scale_factors=leaves["scale_factors"],
        sh=SH(codebook=leaves["codebook"], indices=rows.flip(0), active_degree=g.sh.active_degree),
    )  # fmt: skip
    result = IndexedRasterizer().render(shared, cam, RasterOptions())
    (result.image * torch.linspace(0.5, 1.5, result.image.shape[2], device="cuda")).sum().backward()
    return {"image": result.image.detach(), **{name: leaf.grad for name, leaf in leaves.items()}}


def drawn_surfels(*, maps: bool):
    g, cam = draw_scene(replace(MANY, n=4000, geometry="surfels"), 3, torch.float32)
    g = cast_inputs(g, torch.float32, "cuda")
    leaves = {name: getattr(g, name).clone().requires_grad_() for name in ("means", "opacities", "scales", "quats")}
    asked = {"depth": ALL_DEPTHS, "normals": True, "distortion": True} if maps else {}
    result = SurfelRasterizer().render(replace(g, **leaves), cam, RasterOptions(grad2d=True, alpha=True, **asked))
    shown = [result.image, result.alpha, *([result.normals, result.distortion] if maps else [])]
    shown += [result.depth[name] for name in sorted(result.depth)]
    draw = torch.Generator("cuda").manual_seed(5)
    sum((x * torch.randn(x.shape, device="cuda", generator=draw)).sum() for x in shown).backward()
    found = {name: leaf.grad for name, leaf in leaves.items()}
    return {"image": result.image.detach(), "grad2d": result.grad2d.value, **found}


def scores():
    g, cam = draw_scene(MANY, 3, torch.float32)
    weight = torch.rand(cam.height, cam.width, generator=torch.Generator().manual_seed(1))
    specs = [ScoreSpec(kind, kind) for kind in KINDS]
    specs += [ScoreSpec("tested", "opacity_T", rule="tested"), ScoreSpec("weighted", "hits", weight)]
    specs += [ScoreSpec("squares", "grad_sq", weight)]
    opt = RasterOptions(scores=tuple(specs), fisher=True)
    g, cam = cast_inputs(g, torch.float32, "cuda"), cam.to("cuda")
    found = StandardRasterizer().accumulate(g, [cam, cam], opt)
    alone = StandardRasterizer().accumulate(g, [cam, cam], replace(opt, fisher=False))
    assert found.fisher is not None
    return {**found.scores, "fisher": found.fisher, **{f"{name} alone": x for name, x in alone.scores.items()}}


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=ON_GPU) for name in [*CASES, "codebooks", "scores", "surfels", "surfels with maps"]],
)
def test_five_calls_give_the_same_bits_and_the_values_of_the_fast_sums(name):
    fast = drawn(name)
    with seeded(0, deterministic=True):
        first, *others = (drawn(name) for _ in range(5))
    assert first.keys() == fast.keys()
    for other in others:
        for key, value in first.items():
            assert torch.equal(value, other[key]), key
    for key, value in first.items():
        error = float((value.double() - fast[key].double()).norm() / fast[key].double().norm().clamp(min=1e-30))
        assert error <= 1e-5, f"{key}: relative error {error:.3g}"


@pytest.mark.parametrize("name", ["standard", "c3dgs"])
def test_what_draws_with_ordered_sums_says_so(name):
    info = RasterizerInfo.declared(plugin.register_rasterizers, name)
    for device in ("cpu", "cuda"):
        info.on(device).check_offered(Feature.DETERMINISTIC | Feature.BACKWARD)
    with pytest.raises(CapabilityError, match="FLOAT64"):
        info.on("cuda").check_offered(Feature.FLOAT64)


def test_surfels_are_drawn_with_ordered_sums_too():
    info = RasterizerInfo.declared(plugin.register_rasterizers, "2dgs")
    for device in ("cpu", "cuda"):
        info.on(device).check_offered(Feature.DETERMINISTIC | Feature.BACKWARD | Feature.SURFEL)


def test_what_does_not_declare_one_order_is_refused_by_name():
    info = RasterizerInfo.declared(plugin.register_rasterizers, "flash").on("cuda")
    with pytest.raises(CapabilityError, match="'flash' does not offer DETERMINISTIC"):
        info.check_offered(Feature.DETERMINISTIC)


def test_it_is_asked_for_where_torch_is():
    g, cam = draw_scene(RasterCase(), 1, torch.float32)
    assert Feature.DETERMINISTIC not in Feature.asked_by(RasterOptions(), g)
    with seeded(0, deterministic=True):
        assert Feature.DETERMINISTIC in Feature.asked_by(RasterOptions(), g)
        StandardRasterizer().render(g, cam, RasterOptions())
