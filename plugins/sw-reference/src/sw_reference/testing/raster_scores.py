"""Per-Gaussian scores against the definitions, pair by pair, and against identities."""

from __future__ import annotations

import torch
from torch import Tensor

from splatwizard_core.api import GaussianInputs, Rasterizer, RasterOptions, ScoreSpec
from sw_reference.scores import view_fisher
from sw_reference.testing.facts import check, close, draw
from sw_reference.testing.naive_rasterizer import Pair, naive_render
from sw_reference.testing.raster_scenes import RasterCase, cast_inputs, margin_scene, permute_inputs

CASE = RasterCase(
    "scores", n=14, width=37, height=19, color="colors", opacity=(0.8, 0.98), scale=(0.5, 0.9), spread=0.7
)
"""Opaque enough that some pixels stop; two and a half tiles by one and a bit."""
_GAMMA = 0.3


def _value(kind: str, pair: Pair, opacity: Tensor) -> Tensor:
    values: dict[str, Tensor] = {
        "hits": torch.ones_like(pair.alpha),
        "opacity": opacity.expand_as(pair.alpha),
        "opacity_T": opacity * pair.before,
        "blend": pair.alpha * pair.before,
        "blend_sq": (pair.alpha * pair.before) ** 2,
        "blend_max": pair.alpha * pair.before,
        "shown": (pair.alpha * pair.before > 1 / 255).to(pair.alpha),
        "gamma": pair.alpha ** (2 * _GAMMA) * pair.before ** (2 - 2 * _GAMMA),
        "dist": pair.offset.norm(dim=-1),
    }
    return values[kind]


def _compare(r: Rasterizer, device: str, kind: str, rule: str, weight: Tensor | None = None) -> None:
    g, cam = margin_scene(CASE, 3, margin=1e-4)
    spec = ScoreSpec("s", kind, None if weight is None else weight.to(device), rule, _GAMMA)
    expected = torch.zeros(len(g), dtype=torch.float64)
    ws = torch.ones(cam.height, cam.width).double() if weight is None else weight.double()
    pairs = naive_render(g, cam, RasterOptions()).pairs
    assert any(bool((p.tried & ~p.blended).any()) for p in pairs), "no pixel stops: the case shows nothing"
    for pair in pairs:
        values = _value(kind, pair, g.opacities[pair.index]) * (pair.tried if rule == "tested" else pair.blended) * ws
        expected[pair.index] = values.amax() if kind == "blend_max" else values.sum()
    with torch.no_grad():
        single = cast_inputs(g, torch.float32)
        scores = draw(r, device, single, cam.to(dtype=torch.float32), RasterOptions(scores=(spec,))).scores
    assert set(scores) == {"s"}
    close(scores["s"], expected, rtol=1e-4, atol=1e-4)
    if kind in ("hits", "shown") and weight is None:
        assert scores["s"].dtype == torch.int32


def _add_score_checks() -> None:
    for kind, feature in (
        ("hits", "HITS"), ("opacity", "OPACITY"), ("opacity_T", "OPACITY_T"), ("blend", "BLEND"),
        ("blend_sq", "BLEND_SQ"), ("blend_max", "BLEND_MAX"), ("shown", "SHOWN"), ("gamma", "GAMMA"), ("dist", "DIST"),
    ):  # fmt: skip
        for rule in ("blended", "tested"):

            def function(r: Rasterizer, device: str, kind: str = kind, rule: str = rule) -> None:
                _compare(r, device, kind, rule)

            function.__name__ = f"score_{kind}_{rule}_equals_its_definition"
            check(f"SCORE_{feature}")(function)


_add_score_checks()


@check("SCORE_BLEND", "SCORE_HITS", "SCORE_PIXEL_WEIGHT")
def scores_weight_pixels(r: Rasterizer, device: str) -> None:
    weight = torch.rand(CASE.height, CASE.width, generator=torch.Generator().manual_seed(9))
    _compare(r, device, "blend", "blended", weight)
    _compare(r, device, "hits", "blended", weight > 0.5)


@check("SCORE_BLEND", "ALPHA_MAP")
def blend_scores_sum_to_the_covered_light(r: Rasterizer, device: str) -> None:
    g, cam = margin_scene(CASE, 4, torch.float32, 1e-4)
    result = draw(r, device, g, cam, RasterOptions(alpha=True, scores=(ScoreSpec("b", "blend"),)))
    assert result.alpha is not None
    close(result.scores["b"].sum(), result.alpha.sum(), rtol=1e-5)


@check("SCORE_BLEND", "SCORE_HITS", "SCORE_BLEND_MAX")
def accumulate_sums_views(r: Rasterizer, device: str) -> None:
    g, cam = margin_scene(CASE, 4, torch.float32, 1e-4)
    second = cam.resized(29, 23)
    specs = (ScoreSpec("b", "blend"), ScoreSpec("h", "hits"), ScoreSpec("m", "blend_max"))
    options = RasterOptions(scores=specs)
    with torch.no_grad():
        views = [draw(r, device, g, c, options).scores for c in (cam, second)]
        total = r.accumulate(cast_inputs(g, device=device), [c.to(device) for c in (cam, second)], options).scores
    close(total["b"], views[0]["b"] + views[1]["b"])
    assert torch.equal(total["h"], views[0]["h"] + views[1]["h"])
    assert torch.equal(total["m"], torch.maximum(views[0]["m"], views[1]["m"]))


@check("SCORE_GRAD_SQ")
def grad_sq_is_the_squared_derivative_of_each_pixel(r: Rasterizer, device: str) -> None:
    """Against autograd: per pixel, the derivative of the channel sum with respect to that pixel's exp(-sigma)."""
    case = RasterCase("grad_sq", n=6, width=8, height=8, color="colors", opacity=(1.0, 1.3), scale=(0.5, 0.9))
    g, cam = margin_scene(case, 2)
    background = torch.tensor([0.3, 0.1, 0.8])
    for policy in ("exact", "pass"):
        expected = _grad_sq(g, naive_render(g, cam, RasterOptions()).pairs, background.double(), policy)
        options = RasterOptions(
            scores=(ScoreSpec("s", "grad_sq"),), background=background.to(device), clamp_grad=policy
        )
        with torch.no_grad():
            scores = draw(r, device, cast_inputs(g, torch.float32), cam.to(dtype=torch.float32), options).scores
        close(scores["s"], expected, rtol=1e-4, atol=1e-4)


def _grad_sq(g: GaussianInputs, pairs: list[Pair], background: Tensor, policy: str) -> Tensor:
    """One leaf exp(-sigma) per (pixel, splat), so that one backward pass gives every per-pixel derivative."""
    assert g.colors is not None
    leaves = [(p.raw / g.opacities[p.index]).clone().requires_grad_() for p in pairs]
    T: Tensor | float = 1.0
    light: Tensor | float = 0.0
    for pair, leaf in zip(pairs, leaves, strict=True):
        raw = g.opacities[pair.index] * leaf
        alpha = raw.clamp(max=0.99)
        if policy == "pass":
            alpha = raw + (alpha - raw).detach()
        alpha = torch.where(pair.blended, alpha, 0)
        light = light + T * alpha * g.colors[pair.index].sum()
        T = T * (1 - alpha)
    total = light + T * background.sum()
    assert isinstance(total, Tensor)
    torch.autograd.backward(total.sum())
    scores = torch.zeros(len(g), dtype=torch.float64)
    for pair, leaf in zip(pairs, leaves, strict=True):
        assert leaf.grad is not None
        scores[pair.index] = leaf.grad.square().sum()
    return scores


@check("SCORE_REMOVAL")
def removal_is_what_the_squared_error_changes_by(r: Rasterizer, device: str) -> None:
    """Against renders with each Gaussian in turn left out, some of whose alphas are at their clamp."""
    case = RasterCase("removal", n=6, width=19, height=9, color="colors", opacity=(0.6, 1.2), scale=(0.3, 0.8))
    g, cam = margin_scene(case, 2)
    generator = torch.Generator().manual_seed(4)
    background = torch.rand(3, cam.height, cam.width, generator=generator, dtype=torch.float64)
    picture = torch.rand(3, cam.height, cam.width, generator=generator, dtype=torch.float64)
    options = RasterOptions(background=background)

    def render(inputs: GaussianInputs) -> Tensor:
        return naive_render(inputs, cam, options).image

    residual = render(g) - picture
    others = [render(permute_inputs(g, torch.arange(len(g)) != row)) for row in range(len(g))]
    change = torch.stack([(other - picture - residual).square().sum() for other in others])
    cost = torch.stack([(other - picture).square().sum() for other in others]) - residual.square().sum()
    assert bool((cost < 0).any() and (cost > 0).any()), "the case shows one sign only"
    specs = (ScoreSpec("d", "removal"), ScoreSpec("e", "removal", residual=residual.float().to(device)))
    options = RasterOptions(scores=specs, background=background.float().to(device))
    with torch.no_grad():
        scores = draw(r, device, cast_inputs(g, torch.float32), cam.to(dtype=torch.float32), options).scores
    close(scores["d"], change, rtol=2e-4, atol=2e-4)
    close(scores["e"], cost, rtol=2e-4, atol=2e-4)


@check("FISHER")
def fisher_blocks_equal_their_definition(r: Rasterizer, device: str) -> None:
    """Autograd through the definitions of the image, for each pixel and channel: all three ways of a mean."""
    case = RasterCase("fisher", n=4, width=17, height=2, spread=0.6, scale=(0.2, 0.6), opacity=(0.5, 0.95))
    g, cam = margin_scene(case, 5)
    background = torch.tensor([0.2, 0.7, 0.4], dtype=torch.float64)
    expected = view_fisher(lambda inputs: naive_render(inputs, cam, RasterOptions(background=background)).image, g)
    options = RasterOptions(fisher=True, background=background.to(device))
    with torch.no_grad():
        found = draw(r, device, cast_inputs(g, torch.float32), cam.to(dtype=torch.float32), options).fisher
    assert found is not None
    assert found.shape == (len(g), 21)
    # A Gaussian's own largest entry is the measure: small ones differ by many decades.
    scale = expected.abs().amax(dim=1, keepdim=True)
    assert bool((scale > 0).all())
    close(found.cpu() / scale, expected / scale, rtol=1e-3, atol=1e-4)
