"""Fast `noisy_values`: one CPU kernel each for forward and backward."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from splatwizard_native import fast_enabled
from sw_anchors import face
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
        found = [table.new_empty(len(rows), *table.shape[1:]) for table in tables]
        found.append(found[0].new_empty(len(drawn), tables[0].shape[1] + 6 + 3 * tables[3].shape[1]))
        features, scales, offsets, masks, sample = found
        face.noisy_values(
            **_named(rows, mask_weights, steps, uniform, drawn, *tables, threshold=threshold),
            to_features=features, to_scales=scales, to_offsets=offsets, to_masks=masks, to_sample=sample,
        )  # fmt: skip
        return tuple(found)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor | None, ...]:
        saved = ctx.saved_tensors
        features, scales, offsets, masks, sample = (s.contiguous() for s in slopes)
        to_features, to_scales, to_offsets, to_logits = found = [torch.zeros_like(table) for table in saved[5:]]
        to_steps = torch.empty_like(saved[2]) if ctx.needs_input_grad[3] else None
        face.noisy_values_backward(
            **_named(*saved, threshold=ctx.threshold),
            by_features=features, by_scales=scales, by_offsets=offsets, by_masks=masks, by_sample=sample,
            to_features=to_features, to_log_scales=to_scales, to_offsets=to_offsets, to_mask_logits=to_logits,
            to_steps=to_steps,
        )  # fmt: skip
        return None, None, None, to_steps, None, None, *found


def _named(
    rows: Tensor,
    mask_weights: Tensor | None,
    steps: Tensor | None,
    uniform: Tensor | None,
    drawn: Tensor,
    features: Tensor,
    log_scales: Tensor,
    offsets: Tensor,
    mask_logits: Tensor,
    *,
    threshold: float,
) -> dict[str, Any]:
    """Arguments of both operations."""
    return {
        "rows": rows, "features": features, "log_scales": log_scales, "offsets": offsets, "mask_logits": mask_logits,
        "mask_weights": mask_weights, "steps": steps, "uniform": uniform, "drawn": drawn, "threshold": threshold,
    }  # fmt: skip
