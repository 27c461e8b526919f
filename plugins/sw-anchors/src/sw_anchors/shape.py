"""Sizes per anchor: numbers in its three coded groups, and outputs of a context network."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

GROUPS = ("features", "scales", "offsets")
"""Coded attributes of an anchor, [F], [6] (linear, world units) and [3k]; every triple is in this order."""


@dataclass(frozen=True)
class AnchorShape:
    """Sizes per anchor: F features, k offsets; methods add the sizes of their context models.

    features    F
    offsets     k, Gaussians that an anchor can spawn
    """

    features: int
    offsets: int

    @property
    def widths(self) -> tuple[int, int, int]:
        """Numbers per anchor in each group."""
        return self.features, 6, 3 * self.offsets

    @property
    def outputs(self) -> list[int]:
        """Outputs of a context network: mean and scale of each group, then three step logits; 175 as published."""
        return [width for width in self.widths for _ in range(2)] + [len(GROUPS)]

    @property
    def decoded_bytes(self) -> int:
        """Bytes per decoded anchor: position, groups and masks."""
        return 4 * (3 + sum(self.widths)) + self.offsets

    def widened(self, steps: Tensor) -> Tensor:
        """Expand steps per group [V,3] to steps per number [V, sum(widths)]; differentiable."""
        parts = zip(steps.split(1, dim=1), self.widths, strict=True)
        return torch.cat([step.expand(-1, width) for step, width in parts], dim=1)

    def joined(self, features: Tensor, scales: Tensor, offsets: Tensor) -> Tensor:
        """Expand factors per group [S,1], [S,1], [S,k] to factors per number [S, sum(widths)]."""
        threefold = offsets[:, :, None].expand(-1, -1, 3).flatten(1)
        return torch.cat([features.expand(-1, self.features), scales.expand(-1, 6), threefold], dim=1)

    def sums(self, numbers: Tensor) -> Tensor:
        """Return sums per group, [3], of numbers [S, sum(widths)]."""
        return torch.stack([part.sum() for part in numbers.split(list(self.widths), dim=1)])
