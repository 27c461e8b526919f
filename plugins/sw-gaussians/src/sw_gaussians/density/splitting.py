"""Children of split Gaussians: positions sampled from the parent, scales reduced."""

from __future__ import annotations

import torch
from torch import Tensor

from splatwizard_core.api import GaussianModel


def split_children(
    model: GaussianModel, parents: Tensor, count: int, *, shrink: float | None = None
) -> dict[str, Tensor]:
    """Return `count` children per parent [P], tensors [count P, ...]: all first children, then all second, ...

    A child's position is centre + R (scales * z), z ~ N(0, I) from the model's stream of splits. Its scales are the
    parent's divided by `shrink` (None: 0.8 count); all else is copied. Children of a surfel stay in its plane.
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
    """Rotate vectors [N,3] by quaternions [N,4] (w,x,y,z) of any norm."""
    unit = torch.nn.functional.normalize(quats, dim=1, eps=1e-12)
    w, axis = unit[:, :1], unit[:, 1:]
    turned = 2 * torch.linalg.cross(axis, vectors)
    rotated: Tensor = vectors + w * turned + torch.linalg.cross(axis, turned)
    return rotated
