"""Bits of sampled anchors under Gaussians and their derivatives in one kernel."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from sw_anchors import cuda_face, face
from sw_anchors.fast.kernels import fit_kernels


def fits(*tensors: Tensor) -> bool:
    """Whether there is a kernel for the bits of these tensors, all float32 of one device; loads it."""
    return len({t.device for t in tensors}) == 1 and fit_kernels(*tensors)


def bits_of(
    values: Tensor,
    mean: Tensor,
    scale: Tensor,
    steps: Tensor,
    masks: Tensor,
    counted: Tensor,
    smallest: float,
    smallest_scale: float,
) -> tuple[Tensor, Tensor]:
    """Fast version of `rate_model.bits_of`; the incoming gradient must not be negative."""
    given = (values, mean, scale, steps, masks, counted)
    found: tuple[Tensor, Tensor] = _Bits.apply(*given, smallest, smallest_scale)  # type: ignore[no-untyped-call]
    return found


class _Bits(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        x: Tensor,
        mean: Tensor,
        scale: Tensor,
        steps: Tensor,
        masks: Tensor,
        counted: Tensor,
        smallest: float,
        smallest_scale: float,
    ) -> tuple[Tensor, Tensor]:
        learning = x, mean, scale, steps, masks = [t.contiguous() for t in (x, mean, scale, steps, masks)]
        counted = counted.contiguous()
        bits, *slopes = (torch.empty_like(t) for t in (steps, *learning))
        to_x, to_mean, to_scale, to_steps, to_masks = slopes
        operations = cuda_face if x.is_cuda else face
        operations.sample_bits(
            x=x, mean=mean, scale=scale, steps=steps, counted=counted, masks=masks, smallest=smallest,
            smallest_scale=smallest_scale, bits=bits, to_x=to_x, to_mean=to_mean, to_scale=to_scale,
            to_steps=to_steps, to_masks=to_masks,
        )  # fmt: skip
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
