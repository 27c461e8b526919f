"""Distributions of attributes for the file, from the hash grid and its network: on the CPU, with the file's weights."""

from __future__ import annotations

from collections.abc import Callable

import torch
from sw_anchors.attribute_sections import ExactNetwork
from sw_anchors.float_mode import Mode, one_thread
from sw_anchors.lattice import TOP
from sw_anchors.row_parts import FLOAT_NUMBERS, by_parts
from sw_anchors.shape import GROUPS, AnchorShape
from torch import Tensor, nn

from sw_codecs.entropy.rows import RowContext, RowLattice
from sw_hac.mixed_grid import MixedHashGrid
from sw_hac.model import context_of

BlockPrediction = dict[str, tuple[RowContext | RowLattice, Tensor]]
"""Group -> its distributions for a block of n anchors, and quantiser steps [n,1] float64 in units of the values."""


class ExactPredictor:
    """Evaluates grid and network in integers, the same on every machine."""

    def __init__(
        self, grid: MixedHashGrid, network: nn.Sequential, shape: AnchorShape, base_steps: tuple[float, float, float]
    ) -> None:
        """Raises ValueError if the network cannot be evaluated exactly."""
        self._grid, self._network = grid, ExactNetwork(network, shape, base_steps)

    def __call__(self, codes: Tensor) -> BlockPrediction:
        """Predict for anchors at `codes` [n,3] on the lattice."""
        found = self._network.on_lattice(codes, short_features(self._grid), row_width(self._grid))
        return {group: (context, self._network.steps(group, context)) for group, context in found.items()}


class FloatPredictor:
    """Evaluates grid and network in floats, as trained, for comparison with published sizes."""

    def __init__(
        self, grid: MixedHashGrid, network: nn.Sequential, shape: AnchorShape, base_steps: tuple[float, float, float]
    ) -> None:
        self._grid, self._network, self._shape, self._base_steps = grid, network, shape, base_steps

    def __call__(self, codes: Tensor) -> BlockPrediction:
        """Predict for anchors at `codes` [n,3] on the lattice."""
        width = max(row_width(self._grid), self._network[0].out_features)
        with one_thread():
            outputs = by_parts(
                lambda part: self._network(self._grid(part.to(torch.float32) / TOP)), codes, width, FLOAT_NUMBERS
            )
        found = context_of(outputs, self._shape, self._base_steps)
        return {
            group: (RowContext(mean.clamp(-1e6, 1e6), scale.clamp(1e-9, 1e6), step.double()), step.double())
            for group, mean, scale, step in zip(GROUPS, found.means, found.scales, found.steps, strict=True)
        }


def short_features(grid: MixedHashGrid) -> Callable[[Tensor], Tensor]:
    """Features of codes [n,3] as the integer network takes them fastest."""
    return lambda codes: grid.integer_features(codes, torch.int16)


def row_width(grid: MixedHashGrid) -> int:
    """The most numbers that one place has while it is looked up: features, or corners of all cells."""
    return max(grid.width, grid.corners)


PREDICTORS: dict[Mode, type[ExactPredictor] | type[FloatPredictor]] = {"exact": ExactPredictor, "float": FloatPredictor}
