"""Quantizers to one bit: a sign, and a learned mask."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from sw_codecs.quantizers.side_information import within
from sw_codecs.quantizers.straight_through import hard_mask, signs


class SteBinary:
    """+1 where x >= 0, else -1; gradient 1 for |x| <= 1, else 0. Symbols are 1 and 0."""

    def forward(self, x: Tensor) -> Tensor:
        return signs(x)

    __call__ = forward

    def encode(self, x: Tensor) -> tuple[Tensor, dict[str, Any]]:
        """Symbols int64 in {0, 1}; no side information."""
        return (x >= 0).to(torch.int64), {}

    @staticmethod
    def decode(symbols: Tensor, side: dict[str, Any]) -> Tensor:
        """-1 or +1, float32. Raises BitstreamError for other symbols than 0 and 1."""
        return within(symbols, 0, 1).to(torch.float32) * 2 - 1


class SteMask:
    """1 where sigmoid(x) * weight > threshold, else 0; the gradient is that of sigmoid(x) * weight.

    weight   a number or a tensor that broadcasts with x: 1 in HAC and Compact3DGS, a weight per view in CAT-3DGS
    """

    def __init__(self, threshold: float = 0.01) -> None:
        self.threshold = threshold

    def forward(self, x: Tensor, weight: float | Tensor = 1.0) -> Tensor:
        return hard_mask(x, self.threshold, weight)

    __call__ = forward

    def encode(self, x: Tensor, weight: float | Tensor = 1.0) -> tuple[Tensor, dict[str, Any]]:
        """Symbols int64 in {0, 1}; no side information."""
        return (torch.sigmoid(x) * weight > self.threshold).to(torch.int64), {}

    @staticmethod
    def decode(symbols: Tensor, side: dict[str, Any]) -> Tensor:
        """0 or 1, float32. Raises BitstreamError for other symbols."""
        return within(symbols, 0, 1).to(torch.float32)
