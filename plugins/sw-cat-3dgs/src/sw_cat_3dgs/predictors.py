"""The context as the coder needs it: block by block of rows, each part once what it hangs on is known.

Two of them, with the same face: `ExactPredictor` in integers, the same on every machine; `FloatPredictor` as trained,
for comparison with published sizes.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from sw_anchors.coded_anchors import GROUPS
from torch import Tensor

if TYPE_CHECKING:
    from splatwizard_core.api import PluginManager
    from sw_cat_3dgs.context import CatContext

Prediction = dict[str, tuple[Tensor, Tensor, Tensor]]
"""Group -> (mean [n,C], scale [n,C], step [n,1]) in the units of the entropy model's mode."""

FRACTION = 12
MULTIPLIER_OFFSET = 410
"""Of a step in 1/4096 of its base: round(0.1 * 4096) on top of 4096 (1 + tanh t)."""


class ExactPredictor:
    """Integers with 12 fractional bits: means and scales in base steps, a step as its multiple of the base."""

    def __init__(self, context: CatContext, plugins: PluginManager) -> None:
        """Raises ValueError or BitstreamError for weights that no exact evaluation takes."""
        self.context = context
        self._planes = context.triplane.integers()
        shape = context.shape
        units = [1 / base for base, width in zip(shape.base_steps, shape.widths, strict=True) for _ in range(2 * width)]
        network = plugins.context_models.load("integer-mlp")
        self._network = network.from_module(context.network, output_scale=np.array([*units, 1.0, 1.0, 1.0]))
        inverse = {"scales": 1 / shape.base_steps[1], "offsets": 1 / shape.base_steps[2]}
        self._slices: Mapping[str, Any] = context.slices.exact(inverse)
        self._multipliers = plugins.entropy_models.load("conditional-gaussian").step_multipliers

    def first(self, places: Tensor) -> Prediction:
        """What the position alone says of all groups."""
        out = self._network(self.context.triplane.exact(self._planes, places)).split(self.context.shape.splits, dim=1)
        steps = torch.from_numpy(self._multipliers(out[6], MULTIPLIER_OFFSET))
        return {g: (out[2 * i], out[2 * i + 1], steps[:, i : i + 1]) for i, g in enumerate(GROUPS)}

    def shift(self, name: str, known: Tensor) -> tuple[Tensor, Tensor]:
        """What the network `name` of the slices adds to mean and scale, for the known features."""
        mean, scale = self._slices[name](known).chunk(2, dim=1)
        return mean, scale

    def known(self, symbols: Tensor, step: Tensor) -> Tensor:
        """Decoded features as the networks take them: their base step is 1."""
        return symbols * step

    def quantum(self, group: str, step: Tensor) -> Tensor:
        """Steps in units of the values, float64."""
        return step.to(torch.float64) * (self.context.shape.base_steps[GROUPS.index(group)] / (1 << FRACTION))


class FloatPredictor:
    """Floats of the networks as trained, in units of the values."""

    def __init__(self, context: CatContext, plugins: PluginManager) -> None:
        self.context = context

    def first(self, places: Tensor) -> Prediction:
        found = self.context(places)
        return {g: (found.means[i], found.scales[i], found.steps[i]) for i, g in enumerate(GROUPS)}

    def shift(self, name: str, known: Tensor) -> tuple[Tensor, Tensor]:
        mean, scale = self.context.slices.networks[name](known).chunk(2, dim=1)
        return mean, scale

    def known(self, symbols: Tensor, step: Tensor) -> Tensor:
        return (symbols.to(torch.float64) * step).to(torch.float32)

    def quantum(self, group: str, step: Tensor) -> Tensor:
        return step.to(torch.float64)


PREDICTORS = {"exact": ExactPredictor, "float": FloatPredictor}
