"""Kernels for rows of anchors in a training step: copies and noisy numbers on CUDA, the bits of a sample on CPUs too.

Each does what a chain of torch operations does, in one pass over memory; `fused_ops` has both forms.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from sw_anchors.native import ANCHORS

MOST_TENSORS = 12
"""Whose rows are copied together: `kTensors` of kernels/rows.h."""


def fit_kernels(*tensors: Tensor) -> bool:
    """Whether there are kernels for these tensors, of 4 bytes a number on CUDA with rows without gaps; loads them."""
    if not tensors or len(tensors) > MOST_TENSORS:
        return False
    if not all(t.is_cuda and t.element_size() == 4 and t.dim() > 0 for t in tensors):
        return False
    return all(t.is_contiguous() or (t.dim() == 2 and t.stride(1) == 1) for t in tensors) and ANCHORS.has_cuda()


def bits_fit_kernel(*tensors: Tensor) -> bool:
    """Whether there is a kernel for the bits of these tensors; loads it."""
    if all(t.device.type == "cpu" and t.dtype == torch.float32 for t in tensors):
        return ANCHORS.try_load()
    return tensors[0].dtype == torch.float32 and fit_kernels(tensors[0])


def load_rows(rows: Tensor, sources: Sequence[Tensor], into: Sequence[Tensor]) -> None:
    """Copy rows [V] (int64) of each source [N,...] into the first V rows of its target."""
    torch.ops.sw_anchors.load_rows(rows, list(sources), list(into))


def take_rows(rows: Tensor, sources: Sequence[Tensor]) -> list[Tensor]:
    """Rows [S] (int64) of each source [N,...]."""
    found: list[Tensor] = torch.ops.sw_anchors.take_rows(rows, list(sources))
    return found


def scatter_rows(rows: Tensor, sources: Sequence[Tensor], count: int) -> list[Tensor]:
    """For each source [V or more,...] float32 `count` rows of zeros, of which `rows` [V] are its first V rows.

    They share one allocation; each starts at a multiple of 128 bytes.
    """
    found: list[Tensor] = torch.ops.sw_anchors.scatter_rows(rows, list(sources), count)
    return found


def add_rows(rows: Tensor, sources: Sequence[Tensor], into: Sequence[Tensor]) -> None:
    """Add row i of each float32 source [S,...] to row rows[i] (int64) of its target; rows may be named again."""
    torch.ops.sw_anchors.add_rows(rows, list(sources), list(into))


class NoisyRows(torch.autograd.Function):
    """`fused_ops.noisy_rows` by one kernel each way."""

    @staticmethod
    def forward(
        ctx: Any,
        features: Tensor,
        log_scales: Tensor,
        offsets: Tensor,
        mask_logits: Tensor,
        mask_weights: Tensor | None,
        valid: Tensor,
        noise: Tensor | None,
        steps: Tensor | None,
        threshold: float,
    ) -> tuple[Tensor, ...]:
        given = (features, log_scales, offsets, mask_logits, mask_weights, valid, noise, steps)
        values, masks, kept = torch.ops.sw_anchors.row_values(*given, threshold)
        ctx.save_for_backward(*given)
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(kept)
        groups = torch.split(values, [features.shape[1], 6, offsets.shape[1]], dim=1)
        return values, *groups, masks, kept

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *slopes: Tensor | None) -> tuple[Tensor | None, ...]:
        learns = ctx.needs_input_grad[7]
        rows = [s if s is None or s.stride(1) == 1 else s.contiguous() for s in slopes[:5]]
        found = torch.ops.sw_anchors.row_values_backward(*ctx.saved_tensors, rows, learns)
        return *found[:4], None, None, None, found[4] if learns else None, None


class SampleBits(torch.autograd.Function):
    """`fused_ops.sample_bits` by one kernel, which takes the derivatives on its way; backward only scales them."""

    @staticmethod
    def forward(
        ctx: Any,
        x: Tensor,
        mean: Tensor,
        scale: Tensor,
        steps: Tensor,
        masks: Tensor,
        counted: Tensor,
        p_min: float,
        smallest_scale: float,
    ) -> tuple[Tensor, Tensor]:
        given = (each.contiguous() for each in (x, mean, scale, steps, counted, masks))
        bits, *slopes = torch.ops.sw_anchors.sample_bits(*given, p_min, smallest_scale)
        ctx.save_for_backward(*slopes)
        return summed_bits(ctx, bits)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, slope: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        return *torch._foreach_mul(ctx.saved_tensors, slope), None, None, None


def summed_bits(ctx: Any, bits: Tensor) -> tuple[Tensor, Tensor]:
    """(sum of bits [S,3]; the same by group [3], without gradient): what the forward of a node of bits returns."""
    by_group = bits.sum(dim=0)
    ctx.mark_non_differentiable(by_group)
    return by_group.sum(), by_group
