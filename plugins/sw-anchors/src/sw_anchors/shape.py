"""Sizes of an anchor: how many numbers its three coded groups have, and what a context network says of them."""

from __future__ import annotations

from dataclasses import dataclass

GROUPS = ("features", "scales", "offsets")
"""Coded attributes of an anchor, [F], [6] (linear, world units) and [3k]; every triple is in this order."""


@dataclass(frozen=True)
class AnchorShape:
    """F features and k offsets of an anchor; methods add the sizes of their context models.

    features    F
    offsets     k, Gaussians that an anchor can spawn
    """

    features: int
    offsets: int

    @property
    def widths(self) -> tuple[int, int, int]:
        """Numbers of an anchor by group."""
        return self.features, 6, 3 * self.offsets

    @property
    def outputs(self) -> list[int]:
        """Outputs of a context network: mean and scale of each group, then three step logits; 175 as published."""
        return [width for width in self.widths for _ in range(2)] + [len(GROUPS)]

    @property
    def decoded_bytes(self) -> int:
        """Bytes of one decoded anchor: position, groups and masks."""
        return 4 * (3 + sum(self.widths)) + self.offsets
