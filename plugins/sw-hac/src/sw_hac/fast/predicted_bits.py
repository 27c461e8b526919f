"""Bits of a sample of anchors straight from what networks predict, with their derivatives: one node, one kernel.

Means, deviations and weights need no tensors of their own. `Networks` are part of the node: they see the numbers
whose bits are counted, and so both gradients are added where they are written.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Protocol

import torch
from sw_anchors.fast.kernels import fit_kernels
from sw_anchors.fast.sample_bits import summed_bits
from sw_anchors.rate_model import SMALLEST_SCALE, AnchorForecast, Floors
from torch import Tensor
from torch.autograd.function import once_differentiable

from sw_hac import cuda_face, face
from sw_hac.native import HAC


class Networks(Protocol):
    """Networks that give the second Gaussian of each feature, from the numbers whose bits are counted.

    context     whether they see the prediction of the first Gaussian
    columns     [3,F] int32: columns of mean, scale and logit of each feature in their outputs
    """

    context: bool
    columns: Tensor

    def check_for(self, features: int, device: torch.device) -> None:
        """Raise ValueError unless they are of so many features, and on that device."""
        ...

    def packed(self, parameters: tuple[Tensor, ...]) -> Tensor:
        """Return all weights in a row."""
        ...

    def unpacked(self, packed: Tensor, factor: Tensor) -> list[Tensor]:
        """Return the numbers of each parameter among packed ones, times a scalar."""
        ...

    def forward(self, packed: Tensor, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Return hidden layers and outputs."""
        ...

    def backward(self, packed: Tensor, inputs: Tensor, hidden: Tensor, slopes: Tensor) -> tuple[Tensor, Tensor]:
        """Return gradients by inputs and packed weights from those by the outputs."""
        ...


class MaskKind(IntEnum):
    """Effect of masks on the bits of their anchor: `MaskKind` of kernels/mixture.h."""

    ALONE = 0
    GATED = 1
    GATED_MEAN = 2


@dataclass(frozen=True)
class Predicted:
    """Reading of the outputs of networks.

    units           [W] factors of the outputs
    base            base step of the features, in which the networks of channels count
    smallest        floor of a probability
    smallest_scale  floor of a deviation, without gradient below
    scale_floor     floor of a deviation in steps instead, with the gradient that raises it, and of a fifth of a
                    number's way to its mean; 0: none
    masks           what they do
    """

    units: Tensor
    base: float
    smallest: float
    smallest_scale: float
    scale_floor: float
    masks: MaskKind


class Model(Protocol):
    """Members of a rate model that are read here."""

    @property
    def base_steps(self) -> tuple[float, float, float]:
        """Steps before they are predicted."""
        ...

    @property
    def units(self) -> Tensor | None:
        """Factors of the outputs."""
        ...

    @property
    def floors(self) -> Floors:
        """Floors of the rate."""
        ...


def fits(values: Tensor, forecast: AnchorForecast, masks: Tensor, counted: Tensor) -> bool:
    """Whether there are kernels for such tensors, all float32 of one device; loads them."""
    return have_kernels(values, forecast.outputs, forecast.sample_steps, masks, counted)


def have_kernels(*tensors: Tensor) -> bool:
    """Whether there are kernels for such tensors, all float32 of one device; loads them."""
    return len({t.device for t in tensors}) == 1 and fit_kernels(*tensors, module=HAC)


def rate(
    model: Model, values: Tensor, forecast: AnchorForecast, masks: Tensor, counted: Tensor
) -> tuple[Tensor, Tensor]:
    """As `HACRateModel.bits`."""
    given = (values, forecast.outputs, forecast.sample_steps, masks, counted)
    return mixture_bits(*given, reading(model, forecast.outputs, MaskKind.ALONE))


def reading(model: Model, outputs: Tensor, masks: MaskKind) -> Predicted:
    """Return how a rate model reads its outputs [S,W], and what masks do to bits."""
    units = outputs.new_ones(outputs.shape[1]) if model.units is None else model.units
    bounds = (model.floors.probability, SMALLEST_SCALE, model.floors.scale)
    return Predicted(units, model.base_steps[0], *bounds, masks)


def mixture_bits(
    x: Tensor,
    outputs: Tensor,
    steps: Tensor,
    masks: Tensor,
    counted: Tensor,
    predicted: Predicted,
    networks: Networks | None = None,
    parameters: tuple[Tensor, ...] = (),
) -> tuple[Tensor, Tensor]:
    """(bits of S anchors, differentiable; the same by group [3]), where it `fits`.

    x           [S,F+6+3k]
    outputs     [S,W] as `shape.AnchorShape` has them, then any others; with networks the last F are logits of the
                weight of the first Gaussian of each feature
    steps       [S,3] widths of the bins by group
    masks       [S,k] 0 or 1
    counted     [S] factors of the bits of an anchor
    networks    of channels, of `parameters`: they give the second Gaussian; None: there is one

    The derivative by the bits must not be negative. Raises ValueError if the networks are not of the F channels, or
    are on another device.
    """
    if networks is not None:
        networks.check_for(x.shape[1] - 6 - 3 * masks.shape[1], x.device)
    given = [each.contiguous() for each in (x, outputs, steps, masks, counted)]
    bits, by_group = _MixtureBits.apply(*given, predicted, networks, *parameters)  # type: ignore[no-untyped-call]
    return bits, by_group


class _MixtureBits(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        x: Tensor,
        outputs: Tensor,
        steps: Tensor,
        masks: Tensor,
        counted: Tensor,
        predicted: Predicted,
        networks: Networks | None,
        *parameters: Tensor,
    ) -> tuple[Tensor, Tensor]:
        p, features = predicted, x.shape[1] - 6 - 3 * masks.shape[1]
        # What `channel_inputs` and `channel_slopes` are told.
        ctx.read = p.units, features, p.base, networks is not None and networks.context
        second = columns = None
        kept: list[Tensor] = []
        if networks is not None:
            columns, packed = networks.columns, networks.packed(parameters)
            inputs = _channel_inputs(x, outputs, *ctx.read)
            hidden, second = networks.forward(packed, inputs)
            kept = [packed, inputs, hidden]
        learning = [x, outputs, steps, masks, *([] if second is None else [second])]
        bits, *slopes = [torch.empty_like(t) for t in (steps, *learning)]  # derivatives of the sum of bits
        to_x, to_outputs, to_steps, to_masks, *to_second = slopes
        _operations(x).mixture_bits(
            x=x, outputs=outputs, units=p.units, columns=columns, second=second, steps=steps, masks=masks,
            counted=counted, base=p.base, smallest=p.smallest, smallest_scale=p.smallest_scale,
            scale_floor=p.scale_floor, kind=int(p.masks), bits=bits, to_x=to_x, to_outputs=to_outputs,
            to_steps=to_steps, to_masks=to_masks, to_second=next(iter(to_second), None),
        )  # fmt: skip
        ctx.networks = networks
        ctx.save_for_backward(*slopes, *kept)
        return summed_bits(ctx, bits)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, slope: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        by_x, by_outputs, by_steps, by_masks, *rest = ctx.saved_tensors
        networks: Networks | None = ctx.networks
        to_inputs, to_parameters = None, []
        if networks is not None:
            by_second, packed, inputs, hidden = rest
            to_inputs, to_packed = networks.backward(packed, inputs, hidden, by_second)
            to_parameters = networks.unpacked(to_packed, slope)
        to_x, to_outputs = _channel_slopes(slope, by_x, by_outputs, to_inputs, *ctx.read)
        to_steps, to_masks = torch._foreach_mul([by_steps, by_masks], slope)
        return to_x, to_outputs, to_steps, to_masks, None, None, None, *to_parameters


def _operations(x: Tensor) -> Any:
    """The operations of kernels/face.h where a tensor is."""
    return cuda_face if x.is_cuda else face


def _channel_inputs(x: Tensor, outputs: Tensor, units: Tensor, features: int, base: float, context: bool) -> Tensor:
    """Inputs of the networks of channels: features, perhaps context, then a column of ones and zeros."""
    inputs = x.new_empty(len(x), features * (4 if context else 1) // 4 * 4 + 4)
    _operations(x).channel_inputs(
        x=x, outputs=outputs, units=units, features=features, base=base, context=context, inputs=inputs
    )
    return inputs


def _channel_slopes(
    slope: Tensor, by_x: Tensor, by_outputs: Tensor, by_inputs: Tensor | None, units: Tensor, features: int,
    base: float, context: bool,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Gradients by x and outputs, from the derivatives of the bits and the one of these by what follows."""
    to_x, to_outputs = torch.empty_like(by_x), torch.empty_like(by_outputs)
    _operations(by_x).channel_slopes(
        slope=slope, by_x=by_x, by_outputs=by_outputs, by_inputs=by_inputs, units=units, features=features,
        base=base, context=context, to_x=to_x, to_outputs=to_outputs,
    )  # fmt: skip
    return to_x, to_outputs
