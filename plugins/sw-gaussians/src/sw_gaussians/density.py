"""Adaptive density control of 3DGS: which Gaussians are cloned, split and pruned.

Functions on a model and the optimizer that edits its rows; `tasks` makes schedule tasks of them.
Source: 3DGS (arXiv 2308.04079), following the authors' code where it differs from the paper.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from splatwizard_core.api import EmptyModel, GaussianModel, SplatOptimizer

SPLIT_CHILDREN = 2
"""Scales of the children of a split are divided by this."""


@dataclass(frozen=True)
class DensityReport:
    """Counts of Gaussians that one densification changed."""

    cloned: int
    split: int
    pruned: int
    total: int


@torch.no_grad()
def densify_and_prune(
    model: GaussianModel,
    rows: SplatOptimizer,
    *,
    step: int,
    extent: float,
    grad_threshold: float = 2e-4,
    percent_dense: float = 0.01,
    min_opacity: float = 0.005,
    world_prune: float = 0.1,
    size_rules_after: int = 3000,
    prune_screen_px: float | None = None,
    revised_opacity: bool = False,
) -> DensityReport:
    """Clone small, split large Gaussians whose mean screen-space gradient is high; prune faint and huge ones.

    extent              E, world units: scale of the two size thresholds
    grad_threshold      NDC units per view (`>=`)
    percent_dense       largest scale <= percent_dense * E is cloned, above it split
    min_opacity         below it a Gaussian is pruned, 0..1
    world_prune         largest scale > world_prune * E is pruned, but only at steps after `size_rules_after`
    prune_screen_px     pruned if its largest radius since the last densification exceeds this, under the same
                        condition; None (as in the published evaluation): never
    revised_opacity     children of a split get 1 - sqrt(1 - opacity), so that the pair is as opaque as the parent

    Order of rows afterwards: survivors in their old order, clones, first children, second children. All three
    statistics start again at zero. Raises EmptyModel if nothing is left.
    """
    n = model.num_rows
    mean_gradient = (model.grad_accum / model.denom).nan_to_num_(nan=0.0)  # never seen: 0 / 0
    largest = model.scales.amax(dim=1)  # [N]
    hot = mean_gradient >= grad_threshold
    small = largest <= percent_dense * extent
    cloned = (hot & small).nonzero().squeeze(1)  # [C]
    parents = (hot & ~small).nonzero().squeeze(1)  # [P]

    doomed = torch.zeros(n, dtype=torch.bool, device=hot.device)
    if prune_screen_px is not None and step > size_rules_after:
        doomed = model.max_radii2d > prune_screen_px
    doomed[parents] = True

    children = split_children(model, parents, SPLIT_CHILDREN)
    if revised_opacity:
        opacity = torch.sigmoid(children["opacity_logits"])
        children["opacity_logits"] = torch.logit(1 - (1 - opacity).sqrt(), eps=1e-6)
    new_rows = {
        name: torch.cat([getattr(model, name).detach()[cloned], children[name]])  # [C + 2P, ...]
        for name, _ in model.named_parameters(recurse=False)
        if name in model.ROWS
    }
    count = cloned.numel() + SPLIT_CHILDREN * parents.numel()
    if count:
        rows.append_rows(model, new_rows)
        doomed = torch.cat([doomed, doomed.new_zeros(count)])
    for name in ("grad_accum", "denom", "max_radii2d"):
        getattr(model, name).zero_()

    doomed |= model.opacities < min_opacity
    if step > size_rules_after:
        doomed |= model.scales.amax(dim=1) > world_prune * extent
    kept = int((~doomed).sum())
    if kept == 0:
        raise EmptyModel(step)
    rows.keep_rows(model, ~doomed)
    total = n + count
    return DensityReport(
        cloned=cloned.numel(), split=parents.numel(), pruned=total - kept - parents.numel(), total=kept
    )


def split_children(
    model: GaussianModel, parents: Tensor, count: int, *, shrink: float | None = None
) -> dict[str, Tensor]:
    """Rows of `count` children of each of `parents` [P]: all first children, all second, ...; tensors [count P, ...].

    A child lies at centre + R (scales * z) with z from the model's stream of splits, has the parent's scales divided
    by `shrink` (None: 0.8 count), and the rest unchanged; those of a surfel, of two scales, stay in its plane.
    """
    rows = {
        name: parameter.detach()[parents].repeat(count, *[1] * (parameter.dim() - 1))
        for name, parameter in model.named_parameters(recurse=False)
        if name in model.ROWS
    }
    scales = rows["log_scales"].exp()
    noise = torch.randn(scales.shape, generator=model.next_split_generator(), dtype=torch.float32)
    offsets = noise.to(scales) * scales
    if offsets.shape[1] == 2:
        offsets = torch.nn.functional.pad(offsets, (0, 1))  # children of a surfel stay in its plane
    rows["means"] = rows["means"] + rotate(rows["quats"], offsets)
    rows["log_scales"] = (scales / (shrink or 0.8 * count)).log()
    return rows


def rotate(quats: Tensor, vectors: Tensor) -> Tensor:
    """Vectors [N,3] turned by quaternions [N,4] (w,x,y,z), any norm."""
    unit = torch.nn.functional.normalize(quats, dim=1, eps=1e-12)
    w, axis = unit[:, :1], unit[:, 1:]
    turned = 2 * torch.linalg.cross(axis, vectors)
    rotated: Tensor = vectors + w * turned + torch.linalg.cross(axis, turned)
    return rotated


@torch.no_grad()
def reset_opacity(model: GaussianModel, rows: SplatOptimizer, *, ceiling: float = 0.01) -> None:
    """Lower every opacity to at most `ceiling`; the Adam moments of the opacities become zero, their step stays."""
    logit = math.log(ceiling / (1 - ceiling))
    rows.replace(model, "opacity_logits", model.opacity_logits.detach().clamp_max(logit))


def increase_sh_degree(model: GaussianModel) -> None:
    """Draw and train one more band of spherical harmonics, up to the model's own degree."""
    model.active_sh_degree = min(model.active_sh_degree + 1, model.max_sh_degree)
