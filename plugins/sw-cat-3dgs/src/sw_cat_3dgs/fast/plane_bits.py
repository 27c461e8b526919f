"""Bits of all planes and their derivatives in one pass, a tenth of the operators of `spatial_ar.plane_bits`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from splatwizard_native import fast_enabled
from sw_cat_3dgs.fast import plane_kernels
from sw_cat_3dgs.spatial_ar import HIDDEN, LARGEST, NEIGHBORS, P_MIN, RESIDUALS, SMALLEST, SpatialAr

_S_RANGE = -2 * math.log(LARGEST), -2 * math.log(SMALLEST)
_WINDOW = (3, 5)
"""Rows and columns that hold the neighbours: its first twelve places in raster order."""
_BORDER = (2, 2, 2, 0)  # left, right, above, below
_ABOVE = 10  # neighbours in full rows of the window; the other two are to the left
_SHAPES = ((HIDDEN, len(NEIGHBORS)), *((HIDDEN, HIDDEN),) * RESIDUALS, (2, HIDDEN))
_PIECES = tuple(size for out, inputs in _SHAPES for size in (out * inputs, out))
"""Numbers of weight and bias of each layer."""
_PARAMETER_SHAPES = tuple(shape for out, inputs in _SHAPES for shape in ((out, inputs), (out,)))


VALUES_AT_ONCE = 1 << 20
"""Of planes whose bits are computed together: half a gigabyte of layers and derivatives."""


def fits(planes: Sequence[Tensor]) -> bool:
    """Whether to compute the bits of these planes here."""
    return fast_enabled() and all(plane.dtype == planes[0].dtype for plane in planes)


def plane_bits(networks: Sequence[SpatialAr], planes: Sequence[Tensor]) -> Tensor:
    """As `spatial_ar.plane_bits`: all networks and scales at once, as one node of the graph."""
    parameters = [p for network in networks for layer in network.layers for p in (layer.weight, layer.bias)]
    total: Tensor = _JointBits.apply(len(planes), *planes, *parameters)  # type: ignore[no-untyped-call]
    return total


class _JointBits(torch.autograd.Function):
    """Planes per scale [K,C,H,W], then weight and bias of each layer of K networks -> bits of all values.

    Derivatives are taken on the way there: bits are a sum, so backward only scales them. On CUDA one kernel does it
    all; elsewhere some channels at a time, since what layers hold, 380 bytes per value, is then there for one part at a
    time; an anchor has 30 values.
    The incoming derivative must not be negative, as of a loss that has bits as a term: it decides nothing here about
    what pulls a probability off its floor.
    """

    @staticmethod
    def forward(ctx: Any, scales: int, *tensors: Tensor) -> Tensor:
        planes, parameters = tensors[:scales], tensors[scales:]
        k, channels = planes[0].shape[:2]
        planes_learn, learns = any(ctx.needs_input_grad[1 : 1 + scales]), any(ctx.needs_input_grad)
        flat = torch.cat([p.reshape(-1) for p in parameters]).view(k, -1)
        if plane_kernels.fit_kernels(planes) and plane_kernels.has_tensor_cores(planes[0]):
            sums, to_planes = plane_kernels.plane_bits(planes, flat, planes_learn=planes_learn)
            ctx.save_for_backward(sums, *to_planes)
            return sums[:, -2].sum()
        at_once = max(1, VALUES_AT_ONCE // max(1, k * sum(plane.shape[2] * plane.shape[3] for plane in planes)))
        total, found = flat.new_zeros(()), []
        for start in range(0, channels, at_once):
            some = [plane[:, start : start + at_once] for plane in planes]
            part = _PartBits(some, _channel_weights(flat, some[0].shape[1]))
            total += part.bits
            if learns:
                found.append(part.derivatives(planes_learn=planes_learn))
        if learns:
            ctx.save_for_backward(*_joined(found, k))
        return total

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        pieces, *to_planes = ctx.saved_tensors
        to_parameters = [
            piece.view(shape)
            for row in pieces * grad
            for piece, shape in zip(row.split([*_PIECES, 2]), _PARAMETER_SHAPES, strict=False)
        ]
        scales = len(ctx.needs_input_grad) - 1 - len(to_parameters)
        return None, *([part * grad for part in to_planes] or [None] * scales), *to_parameters


def _joined(found: Sequence[tuple[list[Tensor], list[Tensor]]], k: int) -> list[Tensor]:
    """[K, P + 2] derivatives by all parameters, then those by the planes of each scale, if there are any."""
    alone = len(found) == 1
    layers = [each[0] if alone else torch.stack(each).sum(dim=0) for each in zip(*(p for p, _ in found), strict=True)]
    pieces = [part.flatten(1) for both in layers for part in (both[:, :, :-1], both[:, :, -1:])]
    # Two columns more: then each piece is aligned as the optimizer's kernel asks for (16 bytes).
    joined = torch.cat([*pieces, pieces[-1]], dim=1)
    planes = zip(*(planes for _, planes in found), strict=True)
    return [joined, *(each[0] if alone else torch.cat(each, dim=1) for each in planes)]


class _PartBits:
    """Bits of some channels of planes [K,C,H,W] a scale, with what their derivatives need.

    Products are taken channel by channel: a gradient of a weight is a sum over all values, which a GPU takes in one
    thread block per product, so that three products of a million values each would leave it idle. Inputs of a layer
    have a last row of ones, whose weights are the biases: no pass of their own over all values adds or sums them.
    """

    def __init__(self, planes: Sequence[Tensor], weights: list[Tensor]) -> None:
        self.shapes = [plane.shape for plane in planes]
        k, channels = self.shapes[0][:2]
        self.counts = [plane.shape[2] * plane.shape[3] for plane in planes]
        self.weights = weights
        # [K C, inputs + 1, n] of each layer: a column for each value of all scales. The first has fewer inputs.
        stored = weights[0].new_empty(len(_SHAPES), k * channels, HIDDEN + 1, sum(self.counts))
        stored[:, :, HIDDEN] = 1
        self.layers = [stored[0, :, HIDDEN - len(NEIGHBORS) :], *stored[1:].unbind(0)]
        for plane, place in zip(planes, self.layers[0].split(self.counts, dim=2), strict=True):
            _gather_neighbors(plane.flatten(0, 1), place)
        for weight, inputs, following in zip(weights, self.layers, self.layers[1:], strict=False):
            torch.bmm(weight, inputs, out=following[:, :HIDDEN])
            following[:, :HIDDEN].relu_()
        mean, self.s = torch.bmm(weights[-1], self.layers[-1]).unbind(1)  # [K C, n]

        self.offset = torch.cat([plane.flatten(0, 1).flatten(1) for plane in planes], dim=1).sub_(mean)
        self.narrowing = torch.exp(0.5 * self.s.clamp(*_S_RANGE))  # 1 / b
        away = self.offset.abs()
        self.near, self.far = (away - 0.5).mul_(self.narrowing), (away + 0.5).mul_(self.narrowing)
        self.at_near, self.at_far = self.near.abs().neg_().exp_().mul_(0.5), (-self.far).exp_().mul_(0.5)
        # As `further_rates.laplace_mass`.
        self.p = torch.where(self.near >= 0, self.at_near, 1 - self.at_near).sub_(self.at_far)
        self.bits = -self.p.clamp_min(P_MIN).log2_().sum()

    def derivatives(self, *, planes_learn: bool) -> tuple[list[Tensor], list[Tensor]]:
        """Derivatives of the bits: [K, outputs, inputs + 1] by each layer, and by the planes of each scale, or none."""
        k, channels = self.shapes[0][:2]
        # Below its floor a probability still has the gradient that raises it, and a scale out of range that which
        # brings it back, as in `rates.lower_bound`.
        slope = 1 / self.p.clamp_min(P_MIN).mul_(-math.log(2))
        to_far = slope * self.at_far
        to_near = slope.mul_(self.at_near).neg_()
        out = torch.stack([to_near + to_far, to_near * self.near + to_far * self.far], dim=1)  # [K C, 2, n]
        to_x, to_s = out.unbind(1)
        to_x.mul_(self.narrowing).mul_(self.offset.sign())
        own = to_x.clone() if planes_learn else None
        to_x.neg_()
        to_s.mul_(0.5).mul_((self.s >= _S_RANGE[0]) | (to_s < 0)).mul_((self.s <= _S_RANGE[1]) | (to_s > 0))

        found = []
        for i in reversed(range(len(self.weights))):
            found.append(torch.bmm(out, self.layers[i].transpose(1, 2)).unflatten(0, (k, channels)).sum(dim=1))
            if i > 0:
                inputs = self.layers[i][:, :HIDDEN]
                out = torch.bmm(self.weights[i][:, :, :-1].transpose(1, 2), out)
                torch.ops.aten.threshold_backward.grad_input(out, inputs, 0, grad_input=out)
        to_planes: list[Tensor] = []
        if own is not None:
            # The last places of the window are no neighbours: rows of zeros, so that `fold` takes the products as is.
            rest_of_window = _WINDOW[0] * _WINDOW[1] - len(NEIGHBORS)
            first = nn.functional.pad(self.weights[0][:, :, :-1], (0, rest_of_window)).transpose(1, 2)
            parts = zip(self.shapes, out.split(self.counts, dim=2), own.split(self.counts, dim=1), strict=True)
            for shape, part, direct in parts:
                h, w = shape[2:]
                window = torch.bmm(first, part).view(1, -1, h * w)
                folded = nn.functional.fold(window, (h + 2, w + 4), _WINDOW)[:, :, 2:, 2:-2]
                to_planes.append(folded.reshape(shape) + direct.reshape(shape))
        return found[::-1], to_planes


def _channel_weights(flat: Tensor, channels: int) -> list[Tensor]:
    """[K C, outputs, inputs + 1] of each layer, biases last: the parameters flat [K, P], once for each channel."""
    k = len(flat)
    between = RESIDUALS * (HIDDEN + 1) * HIDDEN
    first, middle, last = flat.split([sum(_PIECES[:2]), between, sum(_PIECES[-2:])], dim=1)
    middle = middle.reshape(k * RESIDUALS, -1)  # these layers are alike
    joined = []
    for part, (out, inputs) in ((first, _SHAPES[0]), (middle, _SHAPES[1]), (last, _SHAPES[-1])):
        weight, bias = part.split([out * inputs, out], dim=1)
        joined.append(torch.cat([weight.unflatten(1, (out, inputs)), bias[:, :, None]], dim=2))
    # The identity skip is part of the layer.
    joined[1] = (joined[1] + torch.eye(HIDDEN, HIDDEN + 1, dtype=flat.dtype, device=flat.device)).view(
        k, RESIDUALS, HIDDEN, HIDDEN + 1
    )
    first, middle, last = (each[:, None].expand(-1, channels, *each.shape[1:]).flatten(0, 1) for each in joined)
    return [first, *middle.unbind(1), last]


def _gather_neighbors(planes: Tensor, into: Tensor) -> None:
    """Write the neighbours of each value of planes [P,H,W] into the first rows of `into` [P, 12 or more, H W]."""
    h, w = planes.shape[1:]
    window = nn.functional.pad(planes, _BORDER).unfold(1, h, 1).unfold(2, w, 1)  # [P, 3, 5, H, W]
    into[:, :_ABOVE].unflatten(2, (h, w)).unflatten(1, (2, _WINDOW[1])).copy_(window[:, :2])
    into[:, _ABOVE : len(NEIGHBORS)].unflatten(2, (h, w)).copy_(window[:, 2, :2])
