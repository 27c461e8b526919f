"""Levels of splats in the octree."""

from __future__ import annotations

import math

from torch import Tensor

from sw_wisp.numbers import HIGHEST_LEVEL, LOWEST_LEVEL
from sw_wisp.shape import jacobi, six_of

MARGIN = 0.1
"""Room around the splats while they still move, a share of their extent."""
BITS_PER_LEVEL = 3.0
"""Bits of a finer level where cells are sparse: which of eight children."""


def middle_scales(shape: Tensor, size: Tensor) -> Tensor:
    """Return the middle of the three standard deviations [N] of splats."""
    return jacobi(six_of(shape, size))[0].sort(dim=1).values[:, 1].exp()


def levels_by_cost(costs: Tensor, price: float, edge: float, eta: float) -> Tensor:
    """Return the levels int64 [N] at which the error of a position and its bits together are least.

    costs   [N] >= 0: rise of the loss for a shift of a splat by one world unit, squared, summed over the axes
    price   loss of one bit
    edge    of the root cube
    eta     0.5 is the optimum; finer below

    A place is off by e^2 / 12 in the mean along each axis for an edge e, and a level finer costs three bits: the sum
    costs e^2 / 12 + 3 bits x price x level is least where the slope e^2 ln 4 costs / 12 equals 3 price.
    """
    best = (12 * BITS_PER_LEVEL * price / math.log(4.0)) / costs.double().clamp_min(1e-300)  # e^2
    found = math.log2(edge) - 0.5 * best.log2() - math.log2(2 * eta)
    return found.round().clamp(LOWEST_LEVEL, HIGHEST_LEVEL).long()
