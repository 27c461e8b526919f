"""Context model of CAT-3DGS: triplane, context network and channel slices predict attributes from positions.

The float form is trained. `places` are integers in training and file alike: both look at the very same spots.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from sw_anchors.anchors import linear_layers
from sw_anchors.lattice import low_and_step
from sw_anchors.rate_model import AnchorDistributions, Triple, triple
from sw_anchors.shape import AnchorShape
from torch import Tensor, nn

from splatwizard_native import fast_enabled
from sw_cat_3dgs import spatial_ar
from sw_cat_3dgs.channel_ar import ChannelAr
from sw_cat_3dgs.fast import plane_bits as fast_bits
from sw_cat_3dgs.fast import plane_sites, slices
from sw_cat_3dgs.principal_frame import PrincipalFrame
from sw_cat_3dgs.spatial_ar import ExactSpatialAr, SpatialAr
from sw_cat_3dgs.triplane import GAIN, Triplane
from sw_codecs.context.two_layers import two_layers
from sw_codecs.quantizers.multiples import add_noise

STEP_OFFSET = 1.1
"""A quantiser step is its base times (STEP_OFFSET + tanh t), t a step logit: 0.1 to 2.1 of the base, never zero."""
PLANES = 3


@dataclass(frozen=True)
class ContextShape(AnchorShape):
    """Sizes of all networks: those of an anchor, and the fields of `config.Context`.

    base_steps  quantiser steps of features (1), scales and offsets that predicted ones multiply
    """

    channels: int
    multiples: tuple[int, ...]
    hidden: int
    slices: tuple[int, ...]
    slice_hidden: int
    refine: bool
    base_steps: tuple[float, float, float]

    def planes(self, resolution: int) -> list[tuple[int, int, int]]:
        """Channels, rows and columns of the planes of each scale, for a base resolution."""
        return [(self.channels, m * resolution, m * resolution) for m in self.multiples]


class CatContext(nn.Module):
    """Context model of all anchors.

    frame       [7,3] buffer: `PrincipalFrame.rows` of the triplane's frame; zeros until `fit_frame`
    triplane    planes of resolution 0 until the stage sets them up
    network     feature of a place -> means, scales, step logits
    slices      refine each slice of the features by those before it
    arms        spatial (autoregressive) model of each plane orientation, `SpatialAr`
    rounded     planes are used (and trained) as the file will have them
    in_steps    the network gives means and scales as multiples of base steps, not in the units of the values
    """

    step_offset = STEP_OFFSET

    frame: Tensor
    triplane: Triplane
    network: nn.Sequential
    slices: ChannelAr
    arms: nn.ModuleList

    def __init__(self, shape: ContextShape, generator: torch.Generator) -> None:
        super().__init__()
        self.shape = shape
        self.triplane = Triplane(0, shape.channels, shape.multiples)
        self.network = two_layers(self.triplane.width, shape.hidden, sum(shape.outputs), generator, start="xavier")
        refined = {"scales": 6, "offsets": 3 * shape.offsets} if shape.refine else {}
        self.slices = ChannelAr(shape.slices, refined, hidden=shape.slice_hidden, generator=generator)
        self.arms = nn.ModuleList(SpatialAr(generator) for _ in range(PLANES))
        self.register_buffer("frame", torch.zeros(7, 3))
        self.rounded = False
        self.in_steps = False

    @property
    def resolution(self) -> int:
        """Resolution of the coarsest planes; 0 before they are set up."""
        return int(self.triplane.planes[0].shape[-1]) // self.shape.multiples[0]

    @property
    def spatial_models(self) -> list[SpatialAr]:
        """The models `arms`, one for each plane orientation."""
        return [arm for arm in self.arms if isinstance(arm, SpatialAr)]

    def exact_arms(self) -> list[ExactSpatialAr]:
        """The spatial models in integers. Raises BitstreamError for weights that no exact evaluation takes."""
        return [arm.exact() for arm in self.spatial_models]

    # Set-up

    def fit_frame(self, positions: Tensor, *, neighbors: int = 50, contamination: float = 0.05) -> None:
        """Lay the axes through the anchors [N,3] of now, N > 0."""
        xyz = positions.detach().cpu().numpy()
        frame = PrincipalFrame.fit(xyz, neighbors=neighbors, contamination=contamination)
        self.frame = torch.from_numpy(frame.rows()).to(self.frame)

    def places(self, codes: Tensor, bounds: Tensor) -> Tensor:
        """Integer places [N,3] of position codes on the lattice `bounds`. Raises ValueError for a senseless frame."""
        low, step = low_and_step(bounds.detach().cpu())
        return PrincipalFrame.from_rows(self.frame.cpu().numpy()).unit(codes, low.numpy(), step.numpy())

    @torch.no_grad()
    def start_at(self, values: tuple[Tensor, Tensor, Tensor]) -> None:
        """Let the network predict mean and deviation of each column of the groups, wherever an anchor is."""
        if not len(values[0]):
            return
        bias = linear_layers(self.network)[1].bias
        start = 0
        for value, base, unit in zip(values, self.shape.base_steps, self.units, strict=True):
            for column in (value.mean(dim=0), value.std(dim=0, unbiased=False).clamp(min=base)):
                bias[start : start + len(column)] = column / unit
                start += len(column)
        bias[start:] = 0

    @torch.no_grad()
    def start_slices_at_random(self, generator: torch.Generator) -> None:
        """Draw the last layers of the slices' networks too, as torch draws a linear layer: U(±1 / sqrt(inputs))."""
        for network in self.slices.networks.values():
            last = linear_layers(network)[1]
            for parameter in (last.weight, last.bias):
                drawn = torch.rand(parameter.shape, generator=generator)
                parameter.copy_((2 * drawn - 1) / math.sqrt(last.in_features))

    @property
    def units(self) -> tuple[float, float, float]:
        """Units of the network's means and scales by group."""
        return self.shape.base_steps if self.in_steps else (1.0, 1.0, 1.0)

    @torch.no_grad()
    def fold_units(self) -> None:
        """Let the network predict in the units of the values, which is what the file has."""
        (_, last), start = linear_layers(self.network), 0
        for width, unit in zip(self.shape.widths, self.units, strict=True):
            rows = slice(start, start + 2 * width)
            last.weight[rows] *= unit
            last.bias[rows] *= unit
            start += 2 * width
        self.in_steps = False

    # Prediction in training

    def forward(self, places: Tensor) -> AnchorDistributions:
        """Predict steps and distributions of anchors at places [V,3]; differentiable."""
        return self.read(self.outputs(places))

    def outputs(self, places: Tensor) -> Tensor:
        """Outputs [V, sum(shape.outputs)] of the network for anchors at places [V,3]."""
        look_up = plane_sites.look_up if plane_sites.fits(self.triplane) else Triplane.forward
        found: Tensor = self.network(look_up(self.triplane, places, rounded=self.rounded))
        return found

    def read(self, outputs: Tensor) -> AnchorDistributions:
        """Read outputs [V,W] of the network as means and deviations [V,C] and steps [V,1] of each group."""
        out = outputs.split(self.shape.outputs, dim=1)
        steps = (STEP_OFFSET + torch.tanh(out[6])) * out[6].new_tensor(self.shape.base_steps)  # [V,3]
        means, scales = ([out[2 * i + second] * unit for i, unit in enumerate(self.units)] for second in (0, 1))
        return AnchorDistributions(triple(means), triple(scales), triple(steps.split(1, dim=1)))

    def refined(self, means: Sequence[Tensor], scales: Sequence[Tensor], features: Tensor) -> tuple[Triple, Triple]:
        """Refine means and scales of the groups by features [V,F]."""
        refined = slices.refined if fast_enabled() else ChannelAr.forward
        found = [refined(self.slices, features, means[0], scales[0])]
        for name, mean, scale in zip(("scales", "offsets"), means[1:], scales[1:], strict=True):
            found.append(self.slices.refine(name, features, mean, scale) if self.shape.refine else (mean, scale))
        first, second = zip(*found, strict=True)
        return triple(first), triple(second)

    def triplane_bits(self, noise: Callable[..., Tensor], share: float = 1.0) -> Tensor:
        """Estimate the bits of the planes with noise in place of rounding; symbols and their neighbours alike.

        noise   (*shape) -> U(0,1)
        share   of the channels that are looked at, drawn anew each time; the sum is scaled up
        """
        channels = self.shape.channels
        count = max(1, round(share * channels))
        chosen = torch.argsort(noise(channels))[:count] if count < channels else None
        planes = [plane if chosen is None else plane.index_select(1, chosen) for plane in self.triplane.planes]
        values = [add_noise(GAIN * plane, plane.new_ones(()), noise(*plane.shape)) for plane in planes]
        bits = fast_bits.plane_bits if fast_bits.fits(values) else spatial_ar.plane_bits
        return bits(self.spatial_models, values) * (channels / count)


def plane_bits(context: CatContext, share: float, generator: torch.Generator | None) -> Tensor:
    """Estimate the bits of the planes from a share of their channels; differentiable.

    generator   of the noise, on the device of the planes; None: the default one there
    """
    device = context.frame.device
    return context.triplane_bits(lambda *shape: torch.rand(shape, generator=generator, device=device), share)
