"""Distributions of attributes for the file, from a CatContext: each part of a block once what it hangs on is known.

Two of them, with the same face: `ExactPredictor` in integers, the same on every machine; `FloatPredictor` as trained,
for comparison with published sizes.
"""

from __future__ import annotations

import torch
from sw_anchors.attribute_sections import ExactNetwork
from sw_anchors.float_mode import Mode
from sw_anchors.row_parts import FLOAT_NUMBERS, by_parts
from sw_anchors.shape import GROUPS
from torch import Tensor

from sw_cat_3dgs.context import CatContext
from sw_codecs.entropy.rows import RowContext

MULTIPLIER_OFFSET = 410
"""Of a step in 1/4096 of its base: round(0.1 * 4096) on top of 4096 (1 + tanh t)."""


class ExactPredictor:
    """Integers with 12 fractional bits: means and scales in base steps, a step as its multiple of the base."""

    def __init__(self, context: CatContext) -> None:
        """Raises ValueError or BitstreamError for weights that no exact evaluation takes."""
        self.context = context
        self._lookup = context.triplane.exact_lookup(context.triplane.integers())
        shape = context.shape
        self._network = ExactNetwork(context.network, shape, shape.base_steps, step_offset=MULTIPLIER_OFFSET)
        self._slices = context.slices.exact({"scales": 1 / shape.base_steps[1], "offsets": 1 / shape.base_steps[2]})

    def first(self, places: Tensor) -> dict[str, RowContext]:
        """Distributions by group that the position alone gives."""
        return self._network(places, self._lookup, self.context.triplane.width)

    def shift(self, name: str, known: Tensor) -> tuple[Tensor, Tensor]:
        """Changes of mean and scale that the network `name` of the slices makes of the known features."""
        mean, scale = self._slices[name](known).chunk(2, dim=1)
        return mean, scale

    def known(self, symbols: Tensor, context: RowContext) -> Tensor:
        """Decoded features as the networks take them: their base step is 1."""
        multipliers: Tensor = context.step
        return symbols * multipliers

    def steps(self, group: str, context: RowContext) -> Tensor:
        """Quantiser steps in units of the values, float64."""
        return self._network.steps(group, context)


class FloatPredictor:
    """Floats of the networks as trained, in units of the values."""

    def __init__(self, context: CatContext) -> None:
        self.context = context

    def first(self, places: Tensor) -> dict[str, RowContext]:
        """Distributions by group that the position alone gives."""
        width = max(self.context.triplane.width, self.context.shape.hidden)
        found = self.context.read(by_parts(self.context.outputs, places, width, FLOAT_NUMBERS))
        return {g: RowContext(found.means[i], found.scales[i], found.steps[i]) for i, g in enumerate(GROUPS)}

    def shift(self, name: str, known: Tensor) -> tuple[Tensor, Tensor]:
        """Changes of mean and scale that the network `name` of the slices makes of the known features."""
        network = self.context.slices.networks[name]
        mean, scale = by_parts(network, known, self.context.shape.slice_hidden, FLOAT_NUMBERS).chunk(2, dim=1)
        return mean, scale

    def known(self, symbols: Tensor, context: RowContext) -> Tensor:
        """Decoded features as the networks take them."""
        step: Tensor = context.step
        return (symbols.to(torch.float64) * step).to(torch.float32)

    def steps(self, group: str, context: RowContext) -> Tensor:
        """Quantiser steps in units of the values, float64."""
        step: Tensor = context.step
        return step.to(torch.float64)


Predictor = ExactPredictor | FloatPredictor
PREDICTORS: dict[Mode, type[ExactPredictor] | type[FloatPredictor]] = {"exact": ExactPredictor, "float": FloatPredictor}
