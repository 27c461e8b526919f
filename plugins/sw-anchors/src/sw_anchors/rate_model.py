"""Rate models: prediction of how attributes of anchors are distributed, in training and for the file alike.

One object, built from the same grids and networks, gives the bits of a sample in training (`rate`) and the integer
distributions of the file (`exact`): training minimises the size of the file itself. `RateInputs` are what a rate model
predicts from, `AnchorDistributions` what it predicts.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol, TypeAlias

import torch
from torch import Tensor

from sw_anchors.fast import sample_bits
from sw_anchors.shape import AnchorShape
from sw_codecs.entropy.rates import gaussian_bits, lower_bound

Triple = tuple[Tensor, Tensor, Tensor]
RateInputs = tuple[Tensor, ...]
"""Inputs of a rate model: tensors with a row per anchor, without gradients, known before any attribute is decoded."""
Rows: TypeAlias = "Tensor | slice"
"""Rows of `RateInputs`: int64 indices, or a slice to the end."""

SMALLEST_SCALE = 1e-9
"""Lower bound of a predicted standard deviation, as published."""
REACH = 5.0
"""Predicted deviations that a number is away from its mean at most, where `Floors.scale` is set."""


@dataclass(frozen=True)
class AnchorForecast:
    """Prediction of a rate model for V anchors, S of which are a sample whose bits are counted.

    steps           [V,3] quantiser step of each group; differentiable
    sample_steps    [S,3] those of the sample
    outputs         [S,W] outputs of the network for the sample, which the rate model's own `rate` reads
    own_bits        scalar, differentiable: bits of what the rate model itself stores, a grid say; None: not counted
    """

    steps: Tensor
    sample_steps: Tensor
    outputs: Tensor
    own_bits: Tensor | None = None


@dataclass(frozen=True)
class Floors:
    """Lower bounds in the training rate.

    probability     of a value
    scale           of a predicted deviation, in quantiser steps; below it a gradient passes that would raise it, and
                    no number is more than REACH deviations from its mean. 0: SMALLEST_SCALE in units of the values,
                    below which there is no gradient
    """

    probability: float = 1e-6
    scale: float = 0.0


PUBLISHED_FLOORS = Floors()


class RateModel(Protocol):
    """Protocol of rate models.

    A method's own class holds its grids and networks. `CodedAnchors.rate_model` gives it in training, the encoder asks
    the trained model for it, and the decoder builds it from the file.
    """

    def forecast(self, inputs: RateInputs, sample: Rows) -> AnchorForecast:
        """Return quantiser steps of the anchors of `inputs`, and what `rate` needs of its rows `sample`.

        Differentiable; shapes depend on no value, and nothing waits for the device.
        """
        ...

    def rate(self, values: Tensor, forecast: AnchorForecast, masks: Tensor, counted: Tensor) -> tuple[Tensor, Tensor]:
        """Return (bits of the sample, a differentiable scalar; the same by group [3], without gradient).

        values      [S,C] noisy values of all groups side by side, in the order of `shape.GROUPS`
        masks       [S,k] 0 or 1, differentiable
        counted     [S] 1 where an anchor counts, else 0
        """
        ...

    def exact(self) -> object:
        """Return the same distributions in integers, identical on every machine, for coding the file."""
        ...


@dataclass(frozen=True)
class AnchorDistributions:
    """Distributions of the attributes of V anchors: a triple for each of `shape.GROUPS`, in the units of the values.

    means, scales   [V,C] of each group: mean and standard deviation of every number; scales may be <= 0
    steps           [V,1] of each group: quantiser step of the anchor
    """

    means: Triple
    scales: Triple
    steps: Triple


@dataclass(frozen=True)
class AnchorRate:
    """Rate of a training step; `RenderResult.extras["rate"]` in the entropy phase.

    bits        scalar, differentiable: bits per number over the sample, times the share of visible anchors that are
                kept where the sample is of those; 0 for an empty sample
    by_group    [3] bits of features, scales and offsets in the sample, detached
    numbers     scalar: how many numbers the sample has
    own_bits    of the rate model
    """

    bits: Tensor
    by_group: Tensor
    numbers: Tensor
    own_bits: Tensor | None = None

    @classmethod
    def of(cls, bits: Tensor, by_group: Tensor, numbers: Tensor, forecast: AnchorForecast) -> AnchorRate:
        """Return the rate of a sample from its bits and its count of numbers."""
        return cls(bits / numbers.clamp(min=1), by_group, numbers, forecast.own_bits)


def gaussian_rate(
    values: Tensor, mean: Tensor, scale: Tensor, steps: Tensor, masks: Tensor, counted: Tensor, floors: Floors
) -> tuple[Tensor, Tensor]:
    """Return the bits of S anchors under Gaussians, as `RateModel.rate` does.

    values, mean, scale     [S,F+6+3k]
    steps                   [S,3] widths of the bins by group
    masks                   [S,k] factors of the bits of an offset
    counted                 [S] factors of the bits of all other numbers

    The derivative by the bits must not be negative.
    """
    if floors.scale:
        scale = floored(scale, _shape(values, masks).widened(steps), values - mean, floors)
    count = sample_bits.bits_of if sample_bits.fits(values, mean, scale, steps, masks, counted) else bits_of
    return count(values, mean, scale, steps, masks, counted, floors.probability, SMALLEST_SCALE)


def bits_of(
    values: Tensor, mean: Tensor, scale: Tensor, steps: Tensor, masks: Tensor, counted: Tensor, smallest: float,
    smallest_scale: float,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Return what `gaussian_rate` returns.

    smallest        probability of a value
    smallest_scale  deviations below it are taken for it, without a gradient
    """
    shape = _shape(values, masks)
    bits = gaussian_bits(values, mean, scale.clamp(min=smallest_scale), shape.widened(steps), p_min=smallest)
    bits = bits * shape.joined(counted[:, None], counted[:, None], masks)
    return bits.sum(), shape.sums(bits.detach())


def _shape(values: Tensor, masks: Tensor) -> AnchorShape:
    k = masks.shape[1]
    return AnchorShape(values.shape[1] - 6 - 3 * k, k)


def floored(scale: Tensor, steps: Tensor, offsets: Tensor, floors: Floors) -> Tensor:
    """Clamp predicted standard deviations [S,C] from below; differentiable in `scale` alone.

    A deviation at SMALLEST_SCALE has no gradient, nor has a mean many deviations away from a number: a column that is
    there for all anchors never learns, and costs some 20 bits a number.

    steps       [S,C] quantiser steps
    offsets     [S,C] of the numbers from their means
    """
    if floors.scale:
        return lower_bound(scale, torch.maximum(floors.scale * steps, offsets.abs() / REACH).detach())
    return scale.clamp(min=SMALLEST_SCALE)


def triple(parts: Iterable[Tensor]) -> Triple:
    """Return tensors of the three groups in their order."""
    first, second, third = parts
    return first, second, third
