"""The three anchor networks of a view as one autograd node.

Operator launches, not arithmetic, limit a training step. So the first layers of all three are one matrix product, and
the gradient is explicit (benchmarks/train_anchors.py).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from sw_anchors import cuda_face
from sw_anchors.native import ANCHORS
from sw_anchors.neural_gaussians import Networks

MAX_FEATURES, MAX_HIDDEN, MAX_OUTPUTS, BLOCK_BYTES = 51, 51, (16, 80, 32), 164_352
"""Size limits of the CUDA kernel, and its shared memory per block: see kernels/cuda/networks.h."""


def network_outputs(
    center: Tensor, positions: Tensor, features: Tensor, networks: Networks
) -> tuple[Tensor, Tensor, Tensor]:
    """(opacities [V,k] in (-1,1), before masks; outputs [V,7k] of the covariance and [V,3k] of the colour network).

    Of V anchors at positions [V,3] with features [V,F], for a camera at `center` [3], which gets no gradient.
    """
    found: tuple[Tensor, Tensor, Tensor] = _Outputs.apply(center, positions, features, *parameters_of(networks))  # type: ignore[no-untyped-call]
    return found


def parameters_of(networks: Networks) -> list[Tensor]:
    """Weight and bias of the first layer, then of the last one, of each network."""
    return [p for network in networks for layer in (network[0], network[2]) for p in (layer.weight, layer.bias)]


def fits_kernel(positions: Tensor, features: Tensor, parameters: Sequence[Tensor]) -> bool:
    """Whether there is a CUDA kernel for these networks, whose weights must fit into a block's memory; loads it."""
    if not all(t.is_cuda and t.dtype == torch.float32 for t in (positions, features, *parameters)):
        return False
    hidden, outputs = {len(bias) for bias in parameters[1::4]}, [len(bias) for bias in parameters[3::4]]
    if len(hidden) > 1 or max(hidden) > MAX_HIDDEN or features.shape[1] > MAX_FEATURES or features.stride(1) != 1:
        return False
    if any(count > most for count, most in zip(outputs, MAX_OUTPUTS, strict=True)):
        return False
    room = torch.cuda.get_device_properties(features.device).shared_memory_per_block_optin
    return room >= BLOCK_BYTES and ANCHORS.has_cuda()


class _Outputs(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, center: Tensor, positions: Tensor, features: Tensor, *parameters: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        ctx.by_kernel = not ctx.needs_input_grad[1] and fits_kernel(positions, features, parameters)
        if ctx.by_kernel:
            inputs = (center.contiguous(), positions.contiguous(), features)
            found = tuple(features.new_empty(len(features), len(bias)) for bias in parameters[3::4])
            alpha, geometry, color = found
            named = _named(*inputs, parameters)
            cuda_face.view_networks(**named, alpha=alpha, raw_geometry=geometry, raw_color=color)
            ctx.save_for_backward(*inputs, alpha, *parameters)
            return alpha, geometry, color
        first, last = parameters[0::4], parameters[2::4]
        toward = positions - center
        distance = torch.linalg.vector_norm(toward, dim=1, keepdim=True)
        direction = toward / distance
        context = torch.cat([features, direction, distance], dim=1)  # [V, F+4]
        weights = torch.cat(first)
        hidden = torch.addmm(torch.cat(parameters[1::4]), context, weights.t()).relu_()
        parts = torch.split(hidden, [len(w) for w in first], dim=1)
        alpha, geometry, color = (
            torch.addmm(bias, part, weight.t())
            for bias, part, weight in zip(parameters[3::4], parts, last, strict=True)
        )
        alpha.tanh_()
        ctx.save_for_backward(direction, distance, context, weights, hidden, alpha, *last)
        ctx.widths = [len(w) for w in first]
        return alpha, geometry, color

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, to_alpha: Tensor, to_geometry: Tensor, to_color: Tensor) -> tuple[Tensor | None, ...]:
        if ctx.by_kernel:
            center, positions, features, alpha, *parameters = ctx.saved_tensors
            sizes = cuda_face.view_networks_sizes(n=len(features), device=features.get_device())
            to_features = features.new_empty(features.shape)
            starts = list(itertools.accumulate(((p.numel() + 3) // 4 * 4 for p in parameters), initial=0))
            whole = features.new_empty(starts[-1])
            cuda_face.view_networks_backward(
                **_named(center, positions, features, parameters), alpha=alpha, by_alpha=to_alpha.contiguous(),
                by_geometry=to_geometry.contiguous(), by_color=to_color.contiguous(),
                partial=features.new_empty(sizes.parts, sizes.part), to_features=to_features, to_parameters=whole,
            )  # fmt: skip
            places = zip(starts, parameters, strict=False)
            return None, None, to_features, *(whole[at : at + p.numel()].view(p.shape) for at, p in places)
        direction, distance, context, weights, hidden, alpha, *last = ctx.saved_tensors
        outputs = (to_alpha * (1 - alpha * alpha), to_geometry, to_color)
        to_hidden = torch.empty_like(hidden)
        for part, out, weight in zip(torch.split(to_hidden, ctx.widths, dim=1), outputs, last, strict=True):
            torch.mm(out, weight, out=part)
        # In place: fresh memory costs a CPU more than the arithmetic.
        torch.ops.aten.threshold_backward.grad_input(to_hidden, hidden, 0, grad_input=to_hidden)
        to_weights = torch.split(torch.mm(to_hidden.t(), context), ctx.widths)
        to_biases = [part.sum(dim=0) for part in torch.split(to_hidden, ctx.widths, dim=1)]
        to_parameters: list[Tensor] = []
        for i, (out, part) in enumerate(zip(outputs, torch.split(hidden, ctx.widths, dim=1), strict=True)):
            to_parameters += [_aligned(to_weights[i]), to_biases[i], torch.mm(out.t(), part), out.sum(dim=0)]
        to_context = torch.mm(to_hidden, weights)

        to_positions = None
        if ctx.needs_input_grad[1]:
            to_direction = to_context[:, -4:-1]
            along = (to_direction * direction).sum(dim=1, keepdim=True)
            to_positions = (to_direction - direction * along) / distance + direction * to_context[:, -1:]
        return None, to_positions, to_context[:, :-4], *to_parameters


def _named(center: Tensor, positions: Tensor, features: Tensor, parameters: Sequence[Tensor]) -> dict[str, Any]:
    """Arguments of both operations: what the networks see, and their weights and biases."""
    opacity, opacity_bias, geometry, geometry_bias, color, color_bias = (
        p for i, p in enumerate(parameters) if i % 4 >= 2
    )
    return {
        "center": center, "positions": positions, "features": features, "feature_row": features.stride(0),
        "first": parameters[0::4], "first_bias": parameters[1::4], "opacity": opacity, "opacity_bias": opacity_bias,
        "geometry": geometry, "geometry_bias": geometry_bias, "color": color, "color_bias": color_bias,
    }  # fmt: skip


def _aligned(part: Tensor) -> Tensor:
    """Return the tensor 16-byte aligned, as the optimizer's kernel needs; rows of a matrix may not be."""
    return part if part.data_ptr() % 16 == 0 else part.clone()
