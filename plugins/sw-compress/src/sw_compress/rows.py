"""Parts of a model of Gaussians."""

from __future__ import annotations

import sw_gaussians.rows
import torch
from torch import Tensor

from splatwizard_core.api import GaussianModel

IMPORTANCE = "importance"
"""Attribute of a model: what each Gaussian weighs in pictures [N]; the codec `gaussians-quantized` has steps by it."""


@torch.no_grad()
def select(model: GaussianModel, rows: Tensor) -> GaussianModel:
    """The Gaussians of an index [M] or mask [N], in that order, with their importance."""
    part = sw_gaussians.rows.select(model, rows)
    known = getattr(model, IMPORTANCE, None)
    if known is not None:
        setattr(part, IMPORTANCE, known[rows])
    return bare(part)


@torch.no_grad()
def with_degree(model: GaussianModel, degree: int) -> GaussianModel:
    """The same without the SH bands above a degree."""
    if degree >= model.active_sh_degree == model.max_sh_degree:
        return model
    degree = min(degree, model.active_sh_degree)
    raw = {name: getattr(model, name).detach() for name in model.RAW}
    raw["sh_rest"] = raw["sh_rest"][:, : (degree + 1) ** 2 - 1].contiguous()
    return like(model, type(model)(**raw))


def like(model: GaussianModel, other: GaussianModel) -> GaussianModel:
    """`other`, fixed, with the facts that the file of `model` told."""
    other.origin = model.origin
    return bare(other.eval().requires_grad_(False))


def bare(model: GaussianModel) -> GaussianModel:
    """The model without what a training counts for each Gaussian, 12 bytes of each."""
    for name in model.ROWS:
        if name not in model.RAW:
            setattr(model, name, getattr(model, name).new_zeros(0))
    model.ROWS = model.RAW
    return model
