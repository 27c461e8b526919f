"""Fast `noisy_values`: one CPU kernel each for forward and backward."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from splatwizard_native import fast_enabled
from sw_anchors.native import ANCHORS
from sw_anchors.noisy_values import Noise, NoisyValues, Tables


def fits(tables: Tables, mask_weights: Tensor | None) -> bool:
    """Whether there is a kernel for these tensors; loads it."""
    given = [*tables, *([] if mask_weights is None else [mask_weights])]
    right = all(t.dtype == torch.float32 and t.device.type == "cpu" for t in given)
    return fast_enabled() and right and ANCHORS.try_load()


def noisy_values(
    rows: Tensor, tables: Tables, mask_weights: Tensor | None, threshold: float, noise: Noise | None, drawn: Tensor
) -> NoisyValues:
    """Fast version of `sw_anchors.noisy_values.noisy_values`."""
    steps, uniform = (None, None) if noise is None else (noise.steps, noise.uniform)
    steps = steps[0] if steps is not None and len(steps) == 1 and len(rows) != 1 else steps
    return NoisyValues(*_Values.apply(rows, mask_weights, threshold, steps, uniform, drawn, *tables))  # type: ignore[no-untyped-call]


class _Values(torch.autograd.Function):
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
