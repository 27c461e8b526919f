"""Rows of a sample of all anchors in tensors of one size, beside those of the visible ones (`fixed_step.FixedRows`)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from sw_anchors.fast.fused_ops import load_rows

if TYPE_CHECKING:
    from sw_anchors.coded_anchors import CodedAnchors


@dataclass(frozen=True)
class PoolRows:
    """A sample of all anchors in S rows; those that no anchor was drawn for stand for the last one and do not count.

    rows        [S] int64 of the model
    counted     [S] 1 where an anchor was drawn, else 0
    size        scalar float, S
    parameters  rows of `fixed_step.PARAMETERS`, those of offsets flat; they take gradients
    parts       rows of `CodedAnchors.context_rows`
    random      [S (numbers of an anchor)] draws of U(-1/2, 1/2)
    """

    rows: Tensor
    counted: Tensor
    size: Tensor
    parameters: tuple[Tensor, ...]
    parts: tuple[Tensor, ...]
    random: Tensor

    def load(self, model: CodedAnchors, sources: Sequence[Tensor], parts: Sequence[Tensor]) -> None:
        """Draw anchors and noise anew. sources: the model's PARAMETERS; parts: its `context_rows`."""
        rows, counted = model.pool_sample(len(self.rows))
        self.rows.copy_(rows)
        self.counted.copy_(counted)
        self.size.fill_(len(self.rows))
        load_rows(self.rows, [*sources, *parts], [*(mine.detach() for mine in self.parameters), *self.parts])
        self.draw(model)

    def draw(self, model: CodedAnchors) -> None:
        """Draw noise."""
        self.random.uniform_(-0.5, 0.5, generator=model.own_generator())


def bernoulli_rows(uniform: Tensor, count: int, share: float) -> tuple[Tensor, Tensor]:
    """Draw each of `count` > 0 rows with probability `share`, without waiting for a GPU to say how many there are.

    uniform     [S] draws of U(0,1), one for each place of the sample; what more were drawn is left out

    Returns (rows [S] int64 ascending, [S] 1 or 0); places that are left over have the last row, and 0. From one drawn
    row to the next it is a geometric number of rows.
    """
    if share >= 1:
        gaps = torch.ones_like(uniform, dtype=torch.int64)
    else:
        rate = max(-math.log1p(-share), 1e-30)
        gaps = uniform.log().mul_(-1 / rate).floor_().add_(1).clamp_(max=count + 1).to(torch.int64)
    places = gaps.cumsum(0)  # from 1 on; of floats a GPU may sum in any order
    return places.clamp(max=count).sub_(1), (places <= count).to(uniform)
