"""Cells of splats: the root cube, and which level of the octree a splat sits at."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from sw_wisp.numbers import HIGHEST_LEVEL
from sw_wisp.shape import jacobi, six_of

MARGIN = 0.1
"""Room around the splats while they still move, a share of their extent."""
SLACK = 2.0**-20
"""The root cube is larger than the extent by this, so that the last splat lies inside."""
BITS_PER_LEVEL = 3.0
"""What a finer level costs where cells are sparse: three bits that tell which of eight children."""


@dataclass(frozen=True)
class Root:
    """The root cube of the octree: its low corner [3] float64 and its edge, world units."""

    low: Tensor
    edge: float

    @classmethod
    def around(cls, means: Tensor, margin: float = 0.0) -> Root:
        """Return the smallest cube with its low corner at the minimum; `margin`: a share of the extent on all sides."""
        means = means.detach().double()
        low, high = means.amin(dim=0), means.amax(dim=0)
        extent = max(float((high - low).max()), 1e-12)
        return cls(low - margin * extent, extent * (1 + 2 * margin) * (1 + SLACK))

    def cells(self, means: Tensor, levels: Tensor) -> Tensor:
        """Cells int64 [N,3] of splats at means [N,3], each at its level; what lies outside is taken to the border."""
        across = 2.0 ** levels.double()[:, None]
        places = ((means.detach().double() - self.low) / self.edge * across).floor()
        return torch.minimum(places.clamp_min(0), across - 1).long()

    def centres(self, cells: Tensor, levels: Tensor) -> Tensor:
        """Centres [N,3] float64 of cells [N,3] at levels [N]."""
        return self.low + (cells.double() + 0.5) * (self.edge * 2.0 ** -levels.double())[:, None]

    def log_edges(self, levels: Tensor) -> Tensor:
        """Logarithms [N] float32 of the edges of cells at levels [N]."""
        return math.log(self.edge) - levels.float() * math.log(2.0)


def levels_by_size(shape: Tensor, size: Tensor, edge: float, eta: float, bounds: tuple[int, int]) -> Tensor:
    """Return the coarsest levels int64 [N] whose cells have at most `eta` times a splat's middle scale as their edge.

    edge    of the root cube
    bounds  coarsest and finest level
    """
    middle = jacobi(six_of(shape, size))[0].sort(dim=1).values[:, 1]
    return _clipped(((math.log(edge / eta) - middle) / math.log(2.0)).ceil(), bounds)


def levels_by_cost(costs: Tensor, price: float, edge: float, eta: float, bounds: tuple[int, int]) -> Tensor:
    """Return the levels int64 [N] at which the error of a position and its bits together are least.

    costs   [N] >= 0: rise of the loss for a shift of a splat by one world unit, squared, summed over the axes
    price   loss of one bit
    edge    of the root cube
    eta     0.5 is the optimum; finer below

    A place is off by e^2 / 12 in the mean along each axis for an edge e, and a level finer costs three bits: the sum
    costs e^2 / 12 + 3 bits x price x level is least where the slope e^2 ln 4 costs / 12 equals 3 price.
    """
    best = (12 * BITS_PER_LEVEL * price / math.log(4.0)) / costs.double().clamp_min(1e-300)  # e^2
    found = (math.log2(edge) - 0.5 * best.log2() - math.log2(2 * eta)).clamp(0, HIGHEST_LEVEL + 1)
    return _clipped(found.round(), bounds)


def _clipped(levels: Tensor, bounds: tuple[int, int]) -> Tensor:
    return levels.clamp(*bounds).long()
