"""Per-Gaussian sums over the pixels of a view: how much each one contributes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from splatwizard_core.api import GaussianInputs, ScoreSpec
from sw_reference.compositing import (
    ALPHA_MIN,
    T_MIN,
    Batch,
    Splats,
    Terms,
    TileLists,
    batches,
    evaluated,
)


def merge_scores(spec: ScoreSpec, total: Tensor, view: Tensor) -> Tensor:
    """Add one view's score to the running total (the maximum for "blend_max")."""
    return torch.maximum(total, view) if spec.kind == "blend_max" else total + view


@torch.no_grad()
def view_scores(
    specs: tuple[ScoreSpec, ...], splats: Splats, lists: TileLists, num_colors: int, background: Tensor
) -> dict[str, Tensor]:
    """Scores of the splats of one view in depth order, ScoreSpec.name -> [V] float64.

    num_colors   the first so many channels are the image's
    background   [C,H,W]
    Over blended pairs: hits 1; opacity o; opacity_T o T; blend alpha T; blend_sq its square; blend_max its maximum;
    shown 1 where alpha T > 1/255; gamma alpha^(2g) T^(2-2g); dist |d| in pixels; grad_sq (o dL/dalpha)^2 for L = sum
    of all pixels and channels (Speedy-Splat, arXiv 2412.00578); removal the sum over channels of d^2 + 2 r d, r the
    residual and d = -alpha dC/dalpha the change of the image if the splat were not there: exactly what its removal adds
    to the squared error, but for splats behind the stop of a pixel. Rule "tested" also counts the splat that triggers
    the stop.
    """
    height, width = background.shape[1:]
    packed = splats.packed
    totals = {s.name: torch.zeros(len(packed), dtype=torch.float64, device=packed.device) for s in specs}
    if not len(packed):
        return totals
    background = background.permute(1, 2, 0)  # [H,W,C]

    for batch in batches(lists, width, height, packed.dtype):
        x = batch.pixels[..., 0].clamp(max=width - 1)
        y = batch.pixels[..., 1].clamp(max=height - 1)
        left = None
        if any(s.kind in ("grad_sq", "removal") for s in specs):
            left = _final_light(splats, lists, batch, num_colors, background[y, x])
        residuals = {s.name: s.residual.to(packed).permute(1, 2, 0)[y, x] for s in specs if s.residual is not None}
        for ids, terms in evaluated(splats, lists, batch):
            slope = None
            if left is not None:
                slope, left = _alpha_slope(terms, num_colors, left)
            for spec in specs:
                counted = terms.weight > 0
                if spec.rule == "tested":
                    counted = counted | (~terms.alive & (terms.alpha > 0) & (terms.before >= T_MIN))
                    counted = counted & ~terms.was_done[..., None]
                pairs = torch.where(
                    counted, _pair_value(spec, terms, slope, residuals.get(spec.name), splats.pass_clamp), 0
                ).double()  # [B,P,L]
                if spec.pixel_weight is not None:
                    pairs = pairs * spec.pixel_weight.to(pairs)[y, x][..., None]
                if spec.kind == "blend_max":
                    totals[spec.name].scatter_reduce_(0, ids.reshape(-1), pairs.amax(dim=1).reshape(-1), "amax")
                else:
                    totals[spec.name].index_add_(0, ids.reshape(-1), pairs.sum(dim=1).reshape(-1))
    return totals


def _pair_value(
    spec: ScoreSpec, terms: Terms, slope: Tensor | None, residual: Tensor | None, pass_clamp: bool
) -> Tensor:
    if spec.kind == "hits":
        return torch.ones_like(terms.alpha)
    if spec.kind == "opacity":
        return terms.opacity.expand_as(terms.alpha)
    if spec.kind == "opacity_T":
        return terms.opacity * terms.before
    if spec.kind in ("blend", "blend_max"):
        return terms.alpha * terms.before
    if spec.kind == "blend_sq":
        return (terms.alpha * terms.before) ** 2
    if spec.kind == "shown":
        return (terms.alpha * terms.before > ALPHA_MIN).to(terms.alpha)
    if spec.kind == "gamma":
        return terms.alpha ** (2 * spec.gamma) * terms.before ** (2 - 2 * spec.gamma)
    if spec.kind == "dist":
        return torch.hypot(terms.dx, terms.dy)
    assert slope is not None
    if spec.kind == "removal":
        change = -terms.alpha[..., None] * slope
        return (change * (change if residual is None else change + 2 * residual[:, :, None])).sum(dim=-1)
    assert spec.kind == "grad_sq"
    derivative = terms.opacity * slope.sum(dim=-1)
    return (derivative if pass_clamp else torch.where(terms.clamped, 0, derivative)) ** 2


def _final_light(splats: Splats, lists: TileLists, batch: Batch, num_colors: int, background: Tensor) -> Tensor:
    """[B,P,C]: the finished image, background [B,P,C] included."""
    light, T = torch.zeros_like(background), torch.ones_like(background[..., 0])
    for _, terms in evaluated(splats, lists, batch):
        light = light + torch.bmm(terms.weight, terms.channels[..., :num_colors])
        T = terms.T
    return light + T[..., None] * background


def _alpha_slope(terms: Terms, num_colors: int, left: Tensor) -> tuple[Tensor, Tensor]:
    """d image / d alpha, [B,P,L,C]; and the light that is left behind the chunk, [B,P,C]."""
    color = terms.channels[..., :num_colors][:, None]  # [B,1,L,C]
    own = torch.cumsum(terms.weight[..., None] * color, dim=-2)
    behind = left[:, :, None] - own
    slope = terms.before[..., None] * color - behind / (1 - terms.alpha)[..., None]
    return slope, behind[:, :, -1] if own.shape[-2] else left


def view_fisher(draw: Callable[[GaussianInputs], Tensor], g: GaussianInputs) -> Tensor:
    """Fisher blocks of one view by brute force: autograd once per pixel and channel. For small images.

    draw    inputs -> image [C,H,W], differentiable; `g` needs means, scales and quats (indexed ones are gathered)
    Returns [N,21] float64, the upper triangle row by row of F = sum over pixels and channels of g g^T,
    g = d image / d (mean, log scale): mean, projected covariance and viewing direction (PUP 3D-GS, arXiv 2406.10219).
    """
    with torch.no_grad():
        g = g.gathered(colors=False)
    assert g.scales is not None
    assert g.quats is not None
    first, second = torch.triu_indices(6, 6, device=g.means.device)
    blocks = torch.zeros(len(g), len(first), dtype=torch.float64, device=g.means.device)
    with torch.enable_grad():
        means, scales = g.means.detach().requires_grad_(), g.scales.detach().requires_grad_()
        image = draw(replace(g, means=means, scales=scales, quats=g.quats.detach()))
        if not image.requires_grad:
            return blocks
        for value in image.flatten():
            of_means, of_scales = torch.autograd.grad(value, (means, scales), retain_graph=True)
            slope = torch.cat([of_means, of_scales * scales.detach()], dim=1).double()  # [N,6]
            blocks += slope[:, first] * slope[:, second]
    return blocks
