"""Per-view gradient statistics in one CUDA launch; sums equal to the plain ones up to rounding of the square root."""

from __future__ import annotations

import torch
from torch import Tensor

from splatwizard_core.api import GaussianModel
from splatwizard_native import Repeated
from sw_gaussians import cuda_face
from sw_gaussians.native import GAUSSIANS

_VIEW = Repeated(cuda_face, "view_statistics")


def accumulate(model: GaussianModel, gradients: Tensor, radii: Tensor) -> bool:
    """Do what `statistics.accumulate_in_torch` does, where the kernel can; return whether it could."""
    sums = model.grad_accum, model.denom, model.max_radii2d
    fits = _fits_kernel(gradients, radii, sums) and GAUSSIANS.has_cuda()
    if fits:
        rows, tensors = radii.shape[0], (gradients, radii, *sums)
        form = gradients.shape[1:], *((t.shape[0] == rows, t.get_device()) for t in tensors)
        _VIEW(
            dict, form, gradients=gradients, radii=radii, rows=rows, grad_accum=sums[0], denom=sums[1],
            max_radii=sums[2],
        )  # fmt: skip
    return fits


def accumulate_fragments(
    sums: Tensor, gradients: Tensor, logits: Tensor, fragments: Tensor, *, least_clear: float
) -> bool:
    """Do what `density.fragments.accumulate_fragments_in_torch` does, where the kernel can; return whether it could."""
    tensors = gradients, logits, fragments, sums
    plain = all(t.is_cuda and t.dtype == torch.float32 and t.is_contiguous() for t in tensors)
    fits = plain and fragments.data_ptr() % 8 == 0 and GAUSSIANS.has_cuda()
    if fits:
        cuda_face.fragment_statistics(
            gradients=gradients.view(-1),
            logits=logits.view(-1),
            fragments=fragments,
            sums=sums,
            least_clear=least_clear,
        )
    return fits


def _fits_kernel(gradients: Tensor, radii: Tensor, sums: tuple[Tensor, ...]) -> bool:
    return (
        gradients.is_cuda
        and radii.dtype == torch.int32
        and radii.is_contiguous()
        and gradients.data_ptr() % 8 == 0
        and all(t.dtype == torch.float32 and t.is_contiguous() for t in (gradients, *sums))
    )
