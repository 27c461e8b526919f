"""SH colours from a codebook, without gathering coefficients or gradients per Gaussian.

A Gaussian at SH degree 3 has 48 coefficients and one colour of 3 numbers for a view. Gathered, the coefficients, their
gradient and its copy in the order of the codebook are 3 x 192 bytes per Gaussian. The kernels read them from the
codebook (csrc/cpu/shared_colors.cpp, csrc/cuda/shared_colors.cu).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from splatwizard_core.api import SH
from sw_rasterizers import face
from sw_rasterizers.memory import empty
from sw_rasterizers.native import cuda_ops
from sw_rasterizers.segments import Segments


def shared_colors(sh: SH, segments: Segments, means: Tensor, center: Tensor, *, clamp: bool) -> Tensor:
    """Return colours [N,3] of the Gaussians as seen from `center` [3]; differentiable by codebook, dc and means [N,3].

    sh          with a codebook [M,K,3], or dc [N,1,3] and a codebook [M,K-1,3]
    segments    of its indices [N]
    clamp       negative colours become 0

    The gradient of a row is the sum over its users in the order of `segments`, the same in every run on every device.
    """
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
        if means.is_cuda:
            found: Tensor = cuda_ops().shared_colors(*tensors, *ctx.arguments)
            return found
        colors = empty(tuple(means.shape), means.dtype)
        face.shade_shared(**_shared(ctx, tensors), colors=colors)
        return colors

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        tensors, segments, gradient = ctx.saved_tensors, ctx.segments, gradient.contiguous()
        means, dc, codebook = tensors
        if means.is_cuda:
            of_codebook, of_dc, of_means = cuda_ops().shared_colors_backward(
                *tensors, *ctx.arguments, segments.order, segments.offsets, gradient
            )
            return of_codebook, of_dc if dc is not None else None, of_means, None, None, None, None
        of_means, of_codebook = (empty(tuple(x.shape), x.dtype) for x in (means, codebook))
        of_dc = None if dc is None else empty(tuple(dc.shape), dc.dtype)
        face.shade_shared_backward(
            **_shared(ctx, tensors), order=segments.order, offsets=segments.offsets, by_colors=gradient,
            passed=empty(tuple(means.shape), means.dtype), of_codebook=of_codebook, of_means=of_means, of_dc=of_dc,
        )  # fmt: skip
        return of_codebook, of_dc, of_means, None, None, None, None


def _shared(ctx: Any, tensors: Sequence[Tensor | None]) -> dict[str, Any]:
    (means, dc, codebook), (rows, center, degree, clamp) = tensors, ctx.arguments
    return {
        "means": means,
        "dc": dc,
        "codebook": codebook,
        "rows": rows,
        "center": center,
        "degree": degree,
        "clamp": clamp,
    }
