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
from sw_rasterizers import cuda, cuda_face, face
from sw_rasterizers.memory import empty
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
            cuda.check()
        colors = _room(means)
        operations = cuda_face if means.is_cuda else face
        operations.shade_shared(**_shared(ctx, tensors), colors=colors)
        return colors

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        tensors, segments, gradient = ctx.saved_tensors, ctx.segments, gradient.contiguous()
        means, dc, codebook = tensors
        of_means, of_codebook, of_dc = _room(means), _room(codebook), None if dc is None else _room(dc)
        # A run of 128 Gaussians carries what belongs to the entry that it ends with.
        carried = means.new_empty(-(-len(means) // 128), 48) if means.is_cuda else None
        operations = cuda_face if means.is_cuda else face
        operations.shade_shared_backward(
            **_shared(ctx, tensors), order=segments.order, offsets=segments.offsets, by_colors=gradient,
            passed=_room(means), carried=carried, of_codebook=of_codebook, of_means=of_means, of_dc=of_dc,
        )  # fmt: skip
        return of_codebook, of_dc, of_means, None, None, None, None


def _room(like: Tensor) -> Tensor:
    return torch.empty_like(like) if like.is_cuda else empty(tuple(like.shape), like.dtype)


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
