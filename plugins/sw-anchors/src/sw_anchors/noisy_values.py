"""Anchor attributes in training: raw or with uniform noise in place of rounding, and their masks."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sw_anchors.shape import AnchorShape
from sw_codecs.quantizers.multiples import add_noise
from sw_codecs.quantizers.straight_through import hard_mask

FULL, QUANTIZED, ENTROPY = "full precision", "quantized training", "entropy training"
"""Training phases: raw values; noise with fixed steps; noise with predicted steps, and a rate loss."""

MASK_THRESHOLD = 0.01
"""A Gaussian is kept where its soft mask exceeds this."""

Tables = tuple[Tensor, Tensor, Tensor, Tensor]
"""Features [N,F], log scales [N,6], offsets [N,k,3] and mask logits [N,k] of all anchors."""


@dataclass(frozen=True)
class Noise:
    """Noise of V anchors: step (u - 1/2) per number; steps [1,3] or [V,3], one per group.

    uniform     [V,C] draws u of U(0,1); they may be overwritten
    """

    steps: Tensor
    uniform: Tensor


@dataclass(frozen=True)
class NoisyValues:
    """Values of V anchors, and of the S whose bits are counted.

    features [V,F], scales [V,6], offsets [V,k,3], masks [V,k] 0 or 1
    sample          [S,C] all numbers of the sample side by side, in the order of `shape.GROUPS`
    """

    features: Tensor
    scales: Tensor
    offsets: Tensor
    masks: Tensor
    sample: Tensor


def noisy_values(
    rows: Tensor, tables: Tables, mask_weights: Tensor | None, threshold: float, noise: Noise | None, drawn: Tensor
) -> NoisyValues:
    """Return noisy values of the anchors `rows` [V], which are unique; differentiable.

    mask_weights    [N,1] or None for 1: a mask is 1 where sigmoid(logit) times its weight exceeds `threshold`, else 0;
                    its gradient is that of sigmoid(logit) times the weight, and none goes to the weight
    drawn           [S] int64 ascending: places in `rows` that the sample takes
    """
    features, log_scales, offsets, logits = (table.index_select(0, rows) for table in tables)
    shape = AnchorShape(features.shape[1], offsets.shape[1])
    values = torch.cat([features, log_scales.exp(), offsets.flatten(1)], dim=1)  # [V,C]
    if noise is not None:
        values = add_noise(values, shape.widened(noise.steps), noise.uniform)
    own, scales, shifts = values.split(list(shape.widths), dim=1)
    masks = hard_mask(logits, threshold, 1.0 if mask_weights is None else mask_weights[rows].detach())
    return NoisyValues(own, scales, shifts.reshape(-1, shape.offsets, 3), masks, values.index_select(0, drawn))


def draws(shape: tuple[int, int], generator: torch.Generator | None, device: torch.device) -> Tensor:
    """Return U(0,1) float32 samples of `shape`; 16 random bits each on a CPU, where 24 bits take 3 times as long."""
    if device.type != "cpu":
        return torch.rand(shape, generator=generator, device=device)
    count = shape[0] * shape[1]
    words = torch.empty((count + 3) // 4, dtype=torch.int64).random_(-(1 << 63), None, generator=generator)
    found: Tensor = words.view(torch.int16)[:count].to(torch.float32).add_(32768.5).mul_(2.0**-16).view(shape)
    return found
