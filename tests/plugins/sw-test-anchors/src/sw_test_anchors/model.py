"""Anchors on a 16-bit grid whose features cost what a context network makes of their positions."""

from typing import Any

import torch
from sw_anchors.anchors import AnchorAttributes, AnchorModel
from torch import Tensor, nn

from splatwizard_core.api import PluginManager
from sw_codecs.entropy.rates import gaussian_bits
from sw_codecs.quantizers.multiples import add_noise

POSITION_BITS = 16
OCTAVES = 5
CONTEXT_INPUTS = 3 * (1 + OCTAVES)
MIN_SCALE = 0.05
"""Standard deviation in steps; the coder has no table below it."""


def context_inputs(codes: Tensor) -> Tensor:
    """Inputs of the context network from 16-bit positions [n,3]: int64 [n, CONTEXT_INPUTS], 12 fractional bits, 0..1.

    Per axis the coordinate, and triangle waves of it whose period halves; integers alone, so that the decoder has
    the encoder's.
    """
    period = 1 << POSITION_BITS
    octaves = torch.arange(OCTAVES, device=codes.device)
    phase = (codes[:, :, None] << octaves) & (period - 1)
    waves = (phase - period // 2).abs() >> (POSITION_BITS - 1 - 12)
    return torch.cat([codes[:, :, None] >> (POSITION_BITS - 12), waves], dim=2).flatten(1)


def context_network(feature_dim: int, hidden: int, generator: torch.Generator) -> nn.Sequential:
    """From CONTEXT_INPUTS to a mean and a standard deviation for each feature, in steps; starts at 0 and 1."""
    first, last = (
        nn.utils.skip_init(nn.Linear, *size) for size in ((CONTEXT_INPUTS, hidden), (hidden, 2 * feature_dim))
    )
    with torch.no_grad():
        first.weight.copy_(torch.randn(first.weight.shape, generator=generator) / CONTEXT_INPUTS**0.5)
        first.bias.zero_()
        last.weight.zero_()
        last.bias.copy_(torch.cat([torch.zeros(feature_dim), torch.ones(feature_dim)]))
    return nn.Sequential(first, nn.ReLU(), last)


class ContextAnchors(AnchorModel):
    """An AnchorModel as it is trained: gridded positions, noise on the features, and their rate in `extras["bits"]`.

    bounds      [2,3] buffer: ends of the position grid, world units
    context     predicts the distribution of the features from the position
    noise       generator of the quantisation noise; whoever trains the model sets it
    """

    def __init__(
        self, *tensors: Tensor, plugins: PluginManager, feature_step: float, generator: torch.Generator, **kwargs: Any
    ) -> None:
        super().__init__(*tensors, generator=generator, **kwargs)
        anchors, features = tensors[:2]
        low, high = anchors.amin(dim=0), anchors.amax(dim=0)
        margin = 0.1 * (high - low).clamp(min=1e-3)  # room for growth
        self.register_buffer("bounds", torch.stack([low - margin, high + margin]))
        self.context = context_network(features.shape[1], self.mlp_color[0].out_features, generator)
        self.feature_step = feature_step
        self.noise = generator
        self._uniform = plugins.quantizers.load("uniform")
        self._rounded = plugins.quantizers.load("ste-round")(feature_step)

    @property
    def grid(self) -> Any:
        """The position quantizer."""
        low, high = self.bounds.tolist()
        return self._uniform(POSITION_BITS, low=low, high=high)

    def positions(self) -> Tensor:
        return self.grid.forward(self.anchors)

    def attributes(self, rows: Tensor) -> AnchorAttributes:
        positions, features = self.positions()[rows], self.features[rows]
        extras = {}
        if self.training:
            uniform = torch.rand(features.shape, generator=self.noise, device=features.device)
            features = add_noise(features, features.new_tensor(self.feature_step), uniform)
            codes, _ = self.grid.encode(positions)
            mean, scale = self.context(context_inputs(codes).to(features) / 4096).chunk(2, dim=1)
            step = self.feature_step
            extras["bits"] = gaussian_bits(features, mean * step, scale.clamp(min=MIN_SCALE) * step, step)  # [V,F]
        else:
            features = self._rounded.forward(features)
        return AnchorAttributes(positions, features, self.offsets[rows], self.log_scales[rows].exp(), extras=extras)
