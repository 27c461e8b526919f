"""The statistics of adaptive density control, on CUDA in one launch."""

from __future__ import annotations

import torch
from torch import Tensor

from splatwizard_core.api import GaussianModel
from splatwizard_core.training.native import TRAINING
from sw_gaussians import density


@torch.no_grad()
def accumulate_statistics(model: GaussianModel, gradients: Tensor, radii: Tensor) -> None:
    """`density.accumulate_statistics`: the same sums, to the last bit of a root, by one kernel where there is CUDA.

    gradients   [N,2] NDC units
    radii       [N] pixels, 0 = not visible
    """
    sums = model.grad_accum, model.denom, model.max_radii2d
    if _fits_kernel(gradients, radii, sums) and TRAINING.has_cuda():
        torch.ops.splatwizard_training.view_statistics(gradients, radii, *sums)
    else:
        density.accumulate_statistics(model, gradients, radii)


def _fits_kernel(gradients: Tensor, radii: Tensor, sums: tuple[Tensor, ...]) -> bool:
    return (
        gradients.is_cuda
        and radii.dtype == torch.int32
        and radii.is_contiguous()
        and gradients.data_ptr() % 8 == 0
        and all(t.dtype == torch.float32 and t.is_contiguous() for t in (gradients, *sums))
    )
