"""Some of the Gaussians of a model, as a model."""

from __future__ import annotations

import torch
from torch import Tensor

from splatwizard_core.api import GaussianModel


@torch.no_grad()
def select(model: GaussianModel, rows: Tensor) -> GaussianModel:
    """Copy the Gaussians of an index [M] or mask [N], in that order, fixed; what the model's file told goes along."""
    raw = {name: getattr(model, name).detach()[rows].contiguous() for name in model.RAW}
    part = type(model)(**raw, active_sh_degree=model.active_sh_degree)
    part.origin = model.origin
    return part.eval().requires_grad_(False)
