"""Context model `spatial-ar`: the distribution of each integer of a plane from its causal neighbours.

A residual network of 1,058 weights looks at twelve neighbours and gives mean and scale of a Laplacian. In training it
runs over whole planes at once; a decoder goes along wavefronts (`wavefront`), with the network in exact integers.
Source: CAT-3DGS (arXiv 2503.00357), after Cool-Chic (arXiv 2212.05458).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from splatwizard_core.errors import BitstreamError
from sw_codecs import wavefront
from sw_codecs.exact_tables import LEVELS
from sw_codecs.integer_mlp import FRACTION, IntegerMlp
from sw_codecs.rates import laplace_bits, lower_bound
from sw_codecs.wavefront import NEIGHBORS

HIDDEN = 16
RESIDUALS = 3
SMALLEST, LARGEST = 0.05, 64.0
"""Scales of the first and the last table of the coder; those in between are spaced evenly in the logarithm."""
P_MIN = 2.0**-16
_S_RANGE = -2 * math.log(LARGEST), -2 * math.log(SMALLEST)

# level = 63 ln(b / SMALLEST) / ln(LARGEST / SMALLEST) with ln b = -s / 2, to the nearest: (offset - slope s) >> 28 for
# s with 12 fractional bits. Literals, so that no logarithm of a decoder's machine decides about a level:
# round(63 / (2 ln 1280) 2^16) and round((63 ln 20 / ln 1280 + 1/2) 2^28).
_SLOPE = 288_539
_OFFSET = 7_215_259_165


class SpatialAr(nn.Module):
    """12 -> 16, ReLU; three times 16 -> 16 plus its input, ReLU; 16 -> 2: mean and s, the scale being exp(-s/2)."""

    def __init__(self, generator: torch.Generator | None = None) -> None:
        super().__init__()
        sizes = [(len(NEIGHBORS), HIDDEN), *[(HIDDEN, HIDDEN)] * RESIDUALS, (HIDDEN, 2)]
        self.layers = nn.ModuleList(nn.utils.skip_init(nn.Linear, *size) for size in sizes)
        for i, layer in enumerate(self.layers):
            for parameter in layer.parameters():
                nn.init.zeros_(parameter)
            if i in (0, len(self.layers) - 1):
                drawn = torch.randn(layer.weight.shape, generator=generator)
                with torch.no_grad():
                    layer.weight.copy_(drawn / layer.out_features**2)

    def forward(self, planes: Tensor) -> tuple[Tensor, Tensor]:
        """(mean, s), each of the shape of `planes` [..., H, W]: integers, or integers with noise in training."""
        h, w = planes.shape[-2:]
        padded = nn.functional.pad(planes.reshape(-1, h, w), (2, 2, 2, 0))
        around = [padded[:, 2 + down : 2 + down + h, 2 + right : 2 + right + w] for down, right in NEIGHBORS]
        a = torch.stack([each.flatten() for each in around])  # [12, n]: one column a value, so weights come first
        last = len(self.layers) - 1
        for i, layer in enumerate(self.layers):
            out = torch.addmm(layer.bias[:, None], layer.weight, a)
            a = out if i == last else torch.relu(out + a if i > 0 else out)
        mean, s = a.view(2, *planes.shape)
        return mean, s

    def bits(self, planes: Tensor) -> Tensor:
        """Bits of each value of `planes` [..., H, W], which are their own context; differentiable.

        Scales are kept to those that the coder has; the gradient that would bring one back passes.
        """
        mean, s = self(planes)
        s = lower_bound(s, -2 * math.log(LARGEST))
        s = -lower_bound(-s, 2 * math.log(SMALLEST))
        return laplace_bits(planes, mean, torch.exp(-0.5 * s), p_min=P_MIN)

    @staticmethod
    def joint_bits(networks: Sequence[SpatialAr], planes: Sequence[Tensor]) -> Tensor:
        """The sum of `networks[k].bits(plane[k])` over all of planes [K, C, H, W] per scale; a differentiable scalar.

        All networks and scales at once, as one node of the graph: a tenth of the operators.
        """
        parameters = [p for network in networks for layer in network.layers for p in (layer.weight, layer.bias)]
        total: Tensor = _JointBits.apply(len(planes), *planes, *parameters)  # type: ignore[no-untyped-call]
        return total

    def state(self) -> dict[str, np.ndarray]:
        """The float32 arrays that go into the file: weight0, bias0, ..."""
        return {
            f"{kind}{i}": getattr(layer, kind).detach().cpu().numpy().astype(np.float32)
            for i, layer in enumerate(self.layers)
            for kind in ("weight", "bias")
        }

    @staticmethod
    def exact(state: Mapping[str, np.ndarray]) -> ExactSpatialAr:
        """The integer form of what `state` gave. Raises BitstreamError if the arrays make no such network."""
        return ExactSpatialAr(state)

    @staticmethod
    def encode(planes: Sequence[np.ndarray], networks: Sequence[ExactSpatialAr]) -> bytes:
        """Bytes of integer planes [K, C, H, W] per scale, orientation k under networks[k] (`wavefront.encode`)."""
        return wavefront.encode(planes, networks)

    @staticmethod
    def decode(
        data: bytes, shapes: Sequence[tuple[int, int, int]], networks: Sequence[ExactSpatialAr]
    ) -> list[np.ndarray]:
        """Inverse of `encode`: shapes are (C, H, W) per scale (`wavefront.decode`)."""
        return wavefront.decode(data, shapes, networks)

    @staticmethod
    def table_bits(planes: Sequence[np.ndarray], networks: Sequence[ExactSpatialAr]) -> float:
        """Bits that `encode` spends on the integers, from the very tables it uses."""
        return wavefront.table_bits(planes, networks)


_WINDOW = (3, 5)
"""Rows and columns that hold the neighbours: its first twelve places in raster order."""
_BORDER = (2, 2, 2, 0)  # left, right, above, below
_SHAPES = ((HIDDEN, len(NEIGHBORS)), *((HIDDEN, HIDDEN),) * RESIDUALS, (2, HIDDEN))
_PIECES = tuple(size for out, inputs in _SHAPES for size in (out * inputs, out))
"""Numbers of weight and bias of each layer."""
_PARAMETER_SHAPES = tuple(shape for out, inputs in _SHAPES for shape in ((out, inputs), (out,)))


class _JointBits(torch.autograd.Function):
    """Planes per scale [K,C,H,W], then weight and bias of each layer of K networks -> bits of all values."""

    @staticmethod
    def forward(ctx: Any, scales: int, *tensors: Tensor) -> Tensor:
        planes, parameters = tensors[:scales], tensors[scales:]
        k, channels = planes[0].shape[:2]
        counts = [plane.shape[2] * plane.shape[3] for plane in planes]
        flat = torch.cat([p.reshape(-1) for p in parameters]).view(k, -1)
        pieces = flat.split(_PIECES, dim=1)
        weights = [piece.view(k, *shape) for piece, shape in zip(pieces[0::2], _SHAPES, strict=True)]
        skip = torch.eye(HIDDEN, dtype=flat.dtype, device=flat.device)
        weights[1:-1] = [weight + skip for weight in weights[1:-1]]  # the identity skip is part of the layer
        # [K,12,C,n]: a column for each value of all scales.
        around = flat.new_empty(k, len(NEIGHBORS), channels, sum(counts))
        for plane, place in zip(planes, around.split(counts, dim=3), strict=True):
            padded = nn.functional.pad(plane.reshape(1, k * channels, *plane.shape[2:]), _BORDER)
            window = nn.functional.unfold(padded, _WINDOW).view(k, channels, -1, plane.shape[2] * plane.shape[3])
            place.copy_(window[:, :, : len(NEIGHBORS)].transpose(1, 2))
        layers = [around.flatten(2)]
        for weight, bias in zip(weights, pieces[1::2], strict=True):
            layers.append(torch.baddbmm(bias[:, :, None], weight, layers[-1]))
            if len(layers) <= len(weights):
                layers[-1].relu_()
        mean, s = layers.pop().unbind(1)

        offset = torch.cat([plane.flatten(2) for plane in planes], dim=2).flatten(1) - mean  # [K, C n]
        narrowing = torch.exp(0.5 * s.clamp(*_S_RANGE))  # 1 / b
        away = offset.abs()
        near, far = (away - 0.5) * narrowing, (away + 0.5) * narrowing
        at_near, at_far = torch.exp(-near.abs()).mul_(0.5), torch.exp(-far).mul_(0.5)
        p = torch.where(near >= 0, at_near, 1 - at_near) - at_far  # as `rates.laplace_mass`
        ctx.save_for_backward(offset, s, narrowing, near, far, at_near, at_far, p, *layers, *weights)
        ctx.shapes, ctx.counts = [plane.shape for plane in planes], counts
        ctx.planes_learn = any(ctx.needs_input_grad[1 : 1 + scales])
        return -torch.log2(p.clamp_min(P_MIN)).sum()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        offset, s, narrowing, near, far, at_near, at_far, p, *rest = ctx.saved_tensors
        layers, weights = rest[: len(_SHAPES)], rest[len(_SHAPES) :]
        k, channels = ctx.shapes[0][:2]
        # Below its floor a probability still has the gradient that raises it, and a scale out of range that which
        # brings it back, as in `rates.lower_bound`.
        slope = grad / (p.clamp_min(P_MIN) * -math.log(2))
        slope = slope * ((p >= P_MIN) | (slope < 0))
        to_near, to_far = -slope * at_near, slope * at_far
        to_x = (to_near + to_far) * narrowing * offset.sign()
        to_s = 0.5 * (to_near * near + to_far * far)
        to_s = to_s * ((s >= _S_RANGE[0]) | (to_s < 0)) * ((s <= _S_RANGE[1]) | (to_s > 0))

        out = torch.stack([-to_x, to_s], dim=1)  # [K, 2, C n]
        found = []
        for i in reversed(range(len(weights))):
            found.append((torch.bmm(out, layers[i].transpose(1, 2)).flatten(1), out.sum(dim=2)))
            if i > 0:
                out = torch.bmm(weights[i].transpose(1, 2), out)
                out = torch.ops.aten.threshold_backward(out, layers[i], 0)
        # Two columns more: then each piece is aligned as the optimizer's kernel asks for (16 bytes).
        joined = torch.cat([piece for pair in reversed(found) for piece in pair] + [found[0][1]], dim=1)
        to_parameters = [
            piece.view(shape)
            for row in joined
            for piece, shape in zip(row.split([*_PIECES, 2]), _PARAMETER_SHAPES, strict=False)
        ]
        if not ctx.planes_learn:
            return None, *[None] * len(ctx.shapes), *to_parameters
        to_around = torch.bmm(weights[0].transpose(1, 2), out).view(k, len(NEIGHBORS), channels, sum(ctx.counts))
        to_planes = []
        own = to_x.view(k, channels, sum(ctx.counts)).split(ctx.counts, dim=2)
        for shape, part, direct in zip(ctx.shapes, to_around.split(ctx.counts, dim=3), own, strict=True):
            h, w = shape[2:]
            window = part.new_zeros(k, channels, _WINDOW[0] * _WINDOW[1], h * w)
            window[:, :, : len(NEIGHBORS)].copy_(part.transpose(1, 2))
            folded = nn.functional.fold(window.view(1, -1, h * w), (h + 2, w + 4), _WINDOW)[:, :, 2:, 2:-2]
            to_planes.append(folded.reshape(shape) + direct.reshape(shape))
        return None, *to_planes, *to_parameters


class ExactSpatialAr:
    """The network of a file in integers: means and table levels do not depend on device or batch."""

    def __init__(self, state: Mapping[str, np.ndarray]) -> None:
        sizes = [(HIDDEN, len(NEIGHBORS)), *[(HIDDEN, HIDDEN)] * RESIDUALS, (2, HIDDEN)]
        weights = []
        for i, size in enumerate(sizes):
            weight, bias = state.get(f"weight{i}"), state.get(f"bias{i}")
            if weight is None or bias is None or weight.shape != size or bias.shape != size[:1]:
                raise BitstreamError(f"layer {i} of a spatial model must be {list(size)} with as many biases")
            skip = np.eye(HIDDEN, dtype=np.float32) if 0 < i <= RESIDUALS else np.float32(0)
            weights.append((weight.astype(np.float32) + skip, bias))  # the identity skip is part of the layer
        try:
            self._network = IntegerMlp(weights)
        except ValueError as error:
            raise BitstreamError(f"a spatial model cannot be used: {error}") from error

    def __call__(self, neighbors: Tensor) -> tuple[np.ndarray, np.ndarray]:
        """(mean int64 [n] with 12 fractional bits, level 0..63 of the scale) for neighbours int64 [n, 12]."""
        mean, s = self._network(neighbors << FRACTION).numpy().T
        return mean, np.clip((_OFFSET - _SLOPE * s) >> 28, 0, LEVELS - 1)
