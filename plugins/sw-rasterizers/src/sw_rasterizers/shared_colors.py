"""Colours of Gaussians that share SH coefficients, which no Gaussian gets for its own, there or back.

A Gaussian at SH degree 3 has 48 coefficients and one colour of 3 numbers for a view. Gathered, the coefficients, their
gradient and its copy in the order of the codebook are 3 x 192 bytes a Gaussian. On the CPU a kernel reads them from the
codebook (csrc/cpu/shared_colors.cpp), elsewhere they are gathered for a block at a time.
"""

from __future__ import annotations

from typing import Any

import torch
from sw_reference.spherical_harmonics import sh_colors
from torch import Tensor

from splatwizard_core.api import SH
from sw_rasterizers.native import MODULE
from sw_rasterizers.segments import Segments

BLOCK = 1 << 17  # Gaussians whose coefficients are there at a time: 25 MB


def shared_colors(sh: SH, segments: Segments, means: Tensor, center: Tensor, *, clamp: bool) -> Tensor:
    """Colours [N,3] of the Gaussians as seen from `center` [3]; differentiable by codebook, dc and means [N,3].

    sh          with a codebook [M,K,3], or dc [N,1,3] and a codebook [M,K-1,3]
    segments    of its indices [N]
    clamp       negative colours become 0

    The gradient of a row is the sum over its users in the order of `segments`, the same in every run on every device.
    """
    function = _OnCpu if means.device.type == "cpu" else _InBlocks
    found: Tensor = function.apply(sh.codebook, sh.dc, means, segments, center, sh.active_degree, clamp)  # type: ignore[no-untyped-call]
    return found


class _OnCpu(torch.autograd.Function):
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
        MODULE.load()
        tensors = [None if each is None else each.detach().contiguous() for each in (means, dc, codebook)]
        ctx.save_for_backward(*tensors)
        ctx.arguments = segments.indices.contiguous(), center.contiguous(), degree, clamp
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


class _InBlocks(torch.autograd.Function):
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
        ctx.save_for_backward(codebook, dc, means)
        ctx.segments, ctx.view = segments, (center, degree, clamp)
        colors = torch.empty_like(means)
        for users in torch.split(segments.order, BLOCK):
            own = None if dc is None else dc[users]
            colors[users] = _colors(codebook[segments.indices[users]], own, means[users], *ctx.view)
        return colors

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        codebook, dc, means = ctx.saved_tensors
        of_codebook, of_means = torch.zeros_like(codebook), torch.zeros_like(means)
        of_dc = None if dc is None else torch.zeros_like(dc)
        order = ctx.segments.order
        users = order[(gradient != 0).any(1)[order]]  # of the others, no pixel saw anything
        rows = ctx.segments.indices[users]  # ascending
        size = BLOCK
        starts = range(0, len(users), size)
        ends = [min(start + size, len(users)) for start in starts]
        edges = rows[[*starts, *(end - 1 for end in ends)]].tolist() if ends else []
        for at, (start, end) in enumerate(zip(starts, ends, strict=True)):
            block, own_rows = users[start:end], rows[start:end]
            first, last = edges[at], edges[len(ends) + at]
            with torch.enable_grad():
                leaves = [codebook[own_rows].requires_grad_(True), means[block].requires_grad_(True)]
                own = None if dc is None else dc[block].requires_grad_(True)
                colors = _colors(leaves[0], own, leaves[1], *ctx.view)
                wanted = leaves if own is None else [*leaves, own]
                parts = torch.autograd.grad(colors, wanted, gradient[block], allow_unused=True)
            if parts[0] is not None:  # None: only dc is active
                span = torch.arange(first, last + 2, device=rows.device)
                sums = torch.segment_reduce(
                    parts[0].flatten(1), "sum", offsets=torch.searchsorted(own_rows, span), axis=0, unsafe=True
                )
                of_codebook[first : last + 1] += sums.view(-1, *codebook.shape[1:])
            if parts[1] is not None:  # None: degree 0 has no direction
                of_means[block] = parts[1]
            if of_dc is not None:
                of_dc[block] = parts[2]
        return of_codebook, of_dc, of_means, None, None, None, None


def _colors(rows: Tensor, dc: Tensor | None, means: Tensor, center: Tensor, degree: int, clamp: bool) -> Tensor:
    dense = rows if dc is None else torch.cat([dc, rows], 1)
    return sh_colors(SH(dense=dense, active_degree=degree), center, means, clamp=clamp)
