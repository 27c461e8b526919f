"""Predictions of a context model for anchors, and the rate that they give."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from torch import Tensor

Triple = tuple[Tensor, Tensor, Tensor]


@dataclass(frozen=True)
class AnchorContext:
    """Prediction of a context model for V anchors: a triple for each of `shape.GROUPS`, in the units of the values.

    means, scales   [V,C] of each group: mean and standard deviation of every number; scales may be <= 0 (see `rate`)
    steps           [V,1] of each group: quantiser step of the anchor
    own_bits        scalar, differentiable: bits of all that the context model itself stores, if it has come along
    """

    means: Triple
    scales: Triple
    steps: Triple
    own_bits: Tensor | None = None


@dataclass(frozen=True)
class AnchorForecast:
    """Prediction of a context model in training: steps of all V anchors, distributions of a sample once it is drawn.

    steps       [V,3] quantiser step of each group; differentiable
    own_bits    as in AnchorContext
    hidden      [V,H] what `sample` starts from, or None; rows of the sample are taken from it
    sample      (rows [S] of the V, their rows of `hidden`, their values [S,C]) -> means and scales [S,C]; the columns
                are those of all groups side by side
    outputs_of  (the rows of `hidden`) -> the same as outputs of a network, see `mixture_bits`; None: only as `sample`
    units       [W] factors of these outputs
    """

    steps: Tensor
    own_bits: Tensor | None
    hidden: Tensor | None
    sample: Callable[[Tensor, Tensor | None, Tensor], tuple[Tensor, Tensor]]
    outputs_of: Callable[[Tensor], Tensor] | None = None
    units: Tensor | None = None


@dataclass(frozen=True)
class AnchorRate:
    """Rate of the anchors of one view; `RenderResult.extras["rate"]` in the entropy phase.

    bits        scalar, differentiable: bits a number over a sample of visible, kept anchors, times the share of visible
                anchors that are kept; 0 for an empty sample
    by_group    [3] bits of features, scales and offsets in the sample, detached
    numbers     scalar: how many numbers the sample has
    own_bits    of the context
    """

    bits: Tensor
    by_group: Tensor
    numbers: Tensor
    own_bits: Tensor | None = None


def triple(parts: Iterable[Tensor]) -> Triple:
    """Tensors of the three groups in their order."""
    first, second, third = parts
    return first, second, third
