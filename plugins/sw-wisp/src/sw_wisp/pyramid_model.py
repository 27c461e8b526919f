"""Context model `pyramid` by itself: distributions of the 22 numbers of each splat from the splats before it."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from sw_wisp.context import ContextNetworks
from sw_wisp.fitting import fitted_context
from sw_wisp.nested import UNIT
from sw_wisp.predicting import PyramidContext
from sw_wisp.pyramid import walked_features


class PyramidModel(nn.Module):
    """Mean, scale level and step of each number, differentiable in the weights of the networks.

    networks    None: fresh ones, which predict the running means as they are, at the base steps of `numbers`

    `sw_wisp.rate` has the bits of numbers under these; a `Scene` of `file` takes `exact()` as its context.
    """

    def __init__(self, networks: ContextNetworks | None = None) -> None:
        super().__init__()
        self.networks = ContextNetworks(adaptive=False) if networks is None else networks

    @classmethod
    def fitted(cls, levels: Tensor, cells: Tensor, values: Tensor, base_steps: Tensor, **options: Any) -> PyramidModel:
        """The model that codes these splats in few bits at base steps [22]; options of `fitting.fitted_context`."""
        return cls(fitted_context(levels, cells, values, base_steps, **options))

    def forward(self, levels: Tensor, cells: Tensor, values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(mean, scale level 0..63, step) [N,22] of splats, each from those before it in the order of a file.

        levels  [N] int64, 3..18, and cells [N,3] int64 at these
        values  [N,22] float32 as a file would hold them, size less the logarithm of the cell's edge

        Networks see how many steps earlier splats lie from their means; so these are predicted twice.
        """
        net = self.networks
        units = values.detach() / net.base_steps
        with torch.no_grad():
            indices = (units - net.prior / UNIT).round()
            features = walked_features(net.prior, levels, cells, units, indices)
            found, _ = net(*features, values)
            indices = ((values - found.mean) / found.steps).round()
            features = walked_features(net.prior, levels, cells, units, indices)
        found, _ = net(*features, values)
        return found.mean, found.scale, found.steps

    def exact(self) -> PyramidContext:
        """The same in the integers of a file."""
        return self.networks.exact()
