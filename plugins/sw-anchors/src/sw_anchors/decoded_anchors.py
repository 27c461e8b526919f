"""Anchor model decoded from a file: dequantised attributes, final masks, ready to render."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from sw_anchors.anchors import AnchorAttributes, AnchorSplats

if TYPE_CHECKING:
    from sw_anchors.sections import AnchorGeometry
    from sw_anchors.shape import AnchorShape


class DecodedAnchors(AnchorSplats):
    """N anchors with final values; rendering predicts and rounds nothing.

    anchors     [N,3] world units
    features    [N,F]
    offsets     [N,k,3]
    scales      [N,6] linear, world units; a coarse quantiser may leave zeros
    masks       [N,k] bool: which Gaussians there are
    """

    ROWS = ("anchors", "features", "offsets", "scales", "masks")

    masks: Tensor

    def __init__(
        self, anchors: Tensor, features: Tensor, offsets: Tensor, scales: Tensor, masks: Tensor, *, hidden: int
    ) -> None:
        """Allocate the networks with zero weights; their state is loaded afterwards."""
        super().__init__()
        self.anchors, self.features = nn.Parameter(anchors), nn.Parameter(features)
        self.offsets, self.scales = nn.Parameter(offsets), nn.Parameter(scales)
        self.register_buffer("masks", masks)
        self.make_networks(features.shape[1], offsets.shape[1], hidden, torch.Generator(), anchors)
        for name in self.NETWORKS:
            for parameter in getattr(self, name).parameters():
                nn.init.zeros_(parameter)

    @classmethod
    def zeros(cls, geometry: AnchorGeometry, shape: AnchorShape, *, hidden: int) -> DecodedAnchors:
        """Make anchors at the positions of `geometry`, with zero attributes and networks to be filled."""
        n, k = len(geometry.codes), shape.offsets
        return cls(
            geometry.positions, torch.zeros(n, shape.features), torch.zeros(n, k, 3), torch.zeros(n, 6), geometry.masks,
            hidden=hidden,
        )  # fmt: skip

    @property
    def num_offsets(self) -> int:
        return self.offsets.shape[1]

    def counts(self) -> dict[str, int]:
        return {"num_anchors": self.num_rows, "num_gaussians": int(self.masks.sum())}

    def positions(self) -> Tensor:
        return self.anchors

    def reach(self) -> Tensor:
        return self.scales[:, :3].abs()

    def attributes(self, rows: Tensor) -> AnchorAttributes:
        return AnchorAttributes(
            self.anchors[rows],
            self.features[rows],
            self.offsets[rows],
            self.scales[rows],
            masks=self.masks[rows].to(self.features),
        )
