"""Values of the visible anchors in training, with noise, as one node of the graph of derivatives.

On the CPU a kernel each way; else the operators of `fused_ops`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from sw_anchors.fast.fused_ops import anchor_values, take_rows, widen
from sw_anchors.native import ANCHORS
from sw_codecs.quantizers.rounding import add_noise

Tables = tuple[Tensor, Tensor, Tensor, Tensor]
"""Features [N,F], log scales [N,6], offsets [N,k,3] and mask logits [N,k] of all anchors."""


@dataclass(frozen=True)
class Noise:
    """Noise of V anchors: step (u - 1/2) on every number, steps [3] or [V,3] of the groups.

    uniform     [V,C] draws u of U(0,1); they may be overwritten
    columns     the group of each number [C], and the same as zeros and ones [C,3]
    """

    steps: Tensor
    uniform: Tensor
    columns: tuple[Tensor, Tensor]


@dataclass(frozen=True)
class NoisyValues:
    """Of V anchors: features [V,F], scales [V,6], offsets [V,k,3], masks [V,k]; sample [S,C], all numbers of S."""

    features: Tensor
    scales: Tensor
    offsets: Tensor
    masks: Tensor
    sample: Tensor


def draws(shape: tuple[int, int], generator: torch.Generator | None, device: torch.device) -> Tensor:
    """U(0,1) float32 of `shape` for noise, of 16 bits each on a CPU, where 24 bits take three times as long."""
    if device.type != "cpu":
        return torch.rand(shape, generator=generator, device=device)
    count = shape[0] * shape[1]
    words = torch.empty((count + 3) // 4, dtype=torch.int64).random_(-(1 << 63), None, generator=generator)
    found: Tensor = words.view(torch.int16)[:count].to(torch.float32).add_(32768.5).mul_(2.0**-16).view(shape)
    return found


def noisy_values(
    rows: Tensor, tables: Tables, mask_weights: Tensor | None, threshold: float, noise: Noise | None, drawn: Tensor
) -> NoisyValues:
    """Values and masks of the anchors `rows` [V] as of `fused_ops.anchor_values`, with noise; differentiable.

    drawn       [S] int64 ascending: places in `rows` that the sample takes
    """
    given = [*tables, *([] if mask_weights is None else [mask_weights])]
    given += [] if noise is None else [noise.steps, noise.uniform]
    if all(t.dtype == torch.float32 and t.device.type == "cpu" for t in given) and ANCHORS.try_load():
        steps, uniform = (None, None) if noise is None else (noise.steps, noise.uniform)
        return NoisyValues(*_ByKernel.apply(rows, mask_weights, threshold, steps, uniform, drawn, *tables))  # type: ignore[no-untyped-call]
    values, masks = anchor_values(rows, *tables, mask_weights, threshold)
    if noise is not None:
        group, _ = noise.columns
        wide = widen(noise.steps, *noise.columns) if noise.steps.dim() == 2 else noise.steps.index_select(0, group)
        values = add_noise(values, wide, noise.uniform)
    k = tables[2].shape[1]
    features, scales, offsets = torch.split(values, [tables[0].shape[1], 6, 3 * k], dim=1)
    return NoisyValues(features, scales, offsets.reshape(-1, k, 3), masks, *take_rows(drawn, values))


class _ByKernel(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        rows: Tensor,
        mask_weights: Tensor | None,
        threshold: float,
        steps: Tensor | None,
        uniform: Tensor | None,
        drawn: Tensor,
        *tables: Tensor,
    ) -> tuple[Tensor, ...]:
        ctx.threshold = threshold
        steps, mask_weights = (t if t is None else t.contiguous() for t in (steps, mask_weights))
        tables = tuple(t.contiguous() for t in tables)
        ctx.save_for_backward(rows, mask_weights, steps, uniform, drawn, *tables)
        found = torch.ops.sw_anchors.noisy_values(rows, tables, mask_weights, threshold, steps, uniform, drawn)
        return tuple(found)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor | None, ...]:
        rows, mask_weights, steps, uniform, drawn, *tables = ctx.saved_tensors
        *to_tables, to_steps = torch.ops.sw_anchors.noisy_values_backward(
            rows, tables, mask_weights, ctx.threshold, steps, uniform, drawn, [s.contiguous() for s in slopes]
        )
        return None, None, None, to_steps if ctx.needs_input_grad[3] else None, None, None, *to_tables
