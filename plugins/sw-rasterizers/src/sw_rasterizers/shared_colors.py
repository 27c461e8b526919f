"""SH colours from a codebook, without gathering coefficients or gradients per Gaussian.

A Gaussian at SH degree 3 has 48 coefficients and one colour of 3 numbers for a view. Gathered, the coefficients, their
gradient and its copy in the order of the codebook are 3 x 192 bytes per Gaussian. The kernels read them from the
codebook (csrc/cpu/shared_colors.cpp, csrc/cuda/shared_colors.cu).
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from splatwizard_core.api import SH
from sw_rasterizers.native import MODULE
from sw_rasterizers.segments import Segments


def shared_colors(sh: SH, segments: Segments, means: Tensor, center: Tensor, *, clamp: bool) -> Tensor:
    """Return colours [N,3] of the Gaussians as seen from `center` [3]; differentiable by codebook, dc and means [N,3].

    sh          with a codebook [M,K,3], or dc [N,1,3] and a codebook [M,K-1,3]
    segments    of its indices [N]
    clamp       negative colours become 0

    The gradient of a row is the sum over its users in the order of `segments`, the same in every run on every device.
    """
    MODULE.load()
    found: Tensor = _SharedColors.apply(sh.codebook, sh.dc, means, segments, center, sh.active_degree, clamp)  # type: ignore[no-untyped-call]
    return found


class _SharedColors(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        codebook: Tensor,
        dc: Tensor | None,
        means: Tensor,
        segments: Segments,
        center: Tensor,
        degree: int,
        clamp: bool,
    ) -> Tensor:
        tensors = [None if each is None else each.detach().contiguous() for each in (means, dc, codebook)]
        ctx.save_for_backward(*tensors)
        ctx.arguments = segments.indices, center.contiguous(), degree, clamp
        ctx.segments = segments
        found: Tensor = torch.ops.sw_rasterizers.shared_colors(*tensors, *ctx.arguments)
        return found

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        codebook, dc, means = torch.ops.sw_rasterizers.shared_colors_backward(
            *ctx.saved_tensors, *ctx.arguments, ctx.segments.order, ctx.segments.offsets, gradient.contiguous()
        )
        return codebook, dc if ctx.saved_tensors[1] is not None else None, means, None, None, None, None
