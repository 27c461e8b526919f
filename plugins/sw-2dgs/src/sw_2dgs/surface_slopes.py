"""Surface losses with their gradients at once: nodes of autograd take the host longer than small pictures the GPU."""

from __future__ import annotations

import torch
from sw_gaussians.fast.whole_step import run_backward
from sw_gaussians.native import GAUSSIANS
from sw_gaussians.surface import surface_depth
from sw_gaussians.surface_losses import disagreement_on_gpu, disagreement_slopes
from torch import Tensor

from splatwizard_core.api import Camera, LossPack, RenderResult


def surface_slopes(
    loss: LossPack, result: RenderResult, camera: Camera, depth_ratio: float, *, distortion: float, normals: float
) -> LossPack | None:
    """Return what `add_surface_losses` does with term "code", unknown to autograd; the maps have their gradients then.

    result  with maps that are leaves of autograd

    None where it cannot: nothing is done then.
    """
    drawn = [x for x, weight in ((result.distortion, distortion), (result.normals, normals)) if weight > 0]
    leaves = [x for x in drawn if x is not None and x.is_leaf and x.requires_grad and x.is_contiguous()]
    if len(leaves) < len(drawn) or not all(x.is_cuda for x in leaves) or not GAUSSIANS.has_cuda():
        return None
    total, terms = loss.total, {}
    if distortion > 0:
        assert result.distortion is not None
        terms["distortion"] = result.distortion.detach().mean()
        total = torch.add(total, terms["distortion"], alpha=distortion)
        result.distortion.grad = _slope_of_mean(result.distortion, distortion)
    if normals > 0:
        assert result.normals is not None
        assert result.alpha is not None
        depth = surface_depth(result.depth, depth_ratio)
        given = depth.detach().contiguous(), result.normals.detach(), result.alpha.detach()
        found = disagreement_on_gpu(*given, camera)
        terms["normals"] = found.mean()
        total = torch.add(total, terms["normals"], alpha=normals)
        to_depth, result.normals.grad = disagreement_slopes(_slope_of_mean(found, normals), *given, camera)
        run_backward((depth,), (to_depth,))
    return LossPack(total, {**loss.parts, **terms})


def _slope_of_mean(x: Tensor, weight: float) -> Tensor:
    return torch.full_like(x, weight / x.numel(), requires_grad=False)
