"""Screen-space gradient statistics, for density control and gradient-based pruners."""

from __future__ import annotations

import torch
from torch import Tensor

from splatwizard_core.api import GaussianModel, RenderResult
from sw_gaussians.fast import statistics as fast

GRADIENT_STATISTICS = ("grad_accum", "denom")
"""Buffers of a GaussianModel: sum of gradient norms, and number of views."""
STATISTICS = (*GRADIENT_STATISTICS, "max_radii2d")
"""Buffers that `collect_statistics` updates: these and the largest screen radius."""


def accumulate_statistics(model: GaussianModel, gradients: Tensor, radii: Tensor) -> None:
    """Add one view to `grad_accum`, `denom` and `max_radii2d`, in place; Gaussians with radius 0 are left alone.

    gradients   [N,2] derivative of the loss by the projected centre, NDC units (RenderResult.grad2d or absgrad2d)
    radii       [N] pixels, 0 = not visible
    """
    if not fast.accumulate(model, gradients, radii):
        accumulate_in_torch(model, gradients, radii)


@torch.no_grad()
def accumulate_in_torch(model: GaussianModel, gradients: Tensor, radii: Tensor) -> None:
    """Plain-torch version of `accumulate_statistics`.

    Dense and in place on purpose: gathering the visible rows first costs more than touching all of them. Squares
    and a root rather than torch.hypot, which is not vectorised (0.2 ms instead of 4.6 for 250,000 rows).
    """
    hidden = radii <= 0
    x, y = gradients[:, 0], gradients[:, 1]
    norms = (x * x).addcmul_(y, y).sqrt_()  # [N]
    model.grad_accum.add_(norms.masked_fill_(hidden, 0.0))
    model.denom.add_(~hidden)
    torch.maximum(model.max_radii2d, radii.to(model.max_radii2d.dtype), out=model.max_radii2d)


def collect_statistics(model: GaussianModel, result: RenderResult) -> None:
    """Schedule task: add this view's screen-space gradients to the model's statistics.

    Those of `RasterOptions.absgrad` where they were rendered (AbsGS, arXiv 2404.10484), else those of `grad2d`.
    """
    gradients = result.absgrad2d or result.grad2d
    if gradients is None:
        raise ValueError(
            "gradient statistics need a stage that renders them, with RasterOptions(grad2d=True) or absgrad=True "
            "(that of 3DGS does where its density control asks for them: adc and budget do)"
        )
    accumulate_statistics(model, gradients.value, result.radii)


def clear_statistics(model: GaussianModel) -> None:
    """Schedule task: reset the accumulated screen-space gradients to zero."""
    for name in GRADIENT_STATISTICS:
        getattr(model, name).zero_()
