"""Anchor networks and Gaussian spawning fused on the CPU: all networks in one pass over the anchors each way.

Hidden layers of all three networks are one matrix product. The covariance and colour networks compute only the outputs
of rendered Gaussians, fewer than half (benchmarks/train_anchors.py).
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from sw_anchors import face
from sw_anchors.fast.kernels import room_for_gaussians, without_gaps
from sw_anchors.fast.networks import parameters_of
from sw_anchors.neural_gaussians import Networks, NeuralGaussians


def fits(positions: Tensor, networks: Networks) -> bool:
    """Whether the kernel takes these networks, of float32 like all other tensors. Positions must not learn."""
    parameters = parameters_of(networks)
    if any(t.device.type != "cpu" or t.dtype != torch.float32 for t in (positions, *parameters)):
        return False
    return not (positions.requires_grad and torch.is_grad_enabled()) and len({len(b) for b in parameters[1::4]}) == 1


def spawn(
    center: Tensor,
    positions: Tensor,
    features: Tensor,
    offsets: Tensor,
    scales: Tensor,
    masks: Tensor | None,
    networks: Networks,
) -> NeuralGaussians:
    """Fast version of `neural_gaussians.spawn`; requires `fits`."""
    found = _Heads.apply(center, positions, features, offsets, scales, masks, *parameters_of(networks))  # type: ignore[no-untyped-call]
    return NeuralGaussians(*found)


class _Heads(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        center: Tensor,
        positions: Tensor,
        features: Tensor,
        offsets: Tensor,
        scales: Tensor,
        masks: Tensor | None,
        *parameters: Tensor,
    ) -> tuple[Tensor, ...]:
        # Features, offsets and scales may be columns of a matrix: of these a row must be without gaps.
        inputs: Any = without_gaps(
            (center, positions, features, offsets, scales, masks), (None, None, (1,), (3, 1), (1,), None)
        )
        center, positions, features, offsets, scales, masks = inputs
        parameters = tuple(p.contiguous() for p in parameters)
        networks = _named("", parameters)
        block, width = _sizes(len(parameters[0]))
        hidden = features.new_empty(-(-len(positions) // block) * block, width)
        alpha, opacities = features.new_empty(offsets.shape[:2]), features.new_empty(offsets.shape[:2])
        count = face.heads_opacities(
            center=center, positions=positions, features=features, masks=masks, **networks,
            feature_row=features.stride(0), hidden=hidden, alpha=alpha, opacities=opacities,
        ).count  # fmt: skip
        drawn = features.new_empty(count, dtype=torch.int64)
        geometry, color = features.new_empty(count, 7), features.new_empty(count, 3)
        means, own_opacities, sizes, quats, colors = gaussians = room_for_gaussians(count, features)
        face.heads_spawn(
            positions=positions, offsets=offsets, scales=scales, masks=masks, **networks, inputs=features.shape[1],
            offset_row=offsets.stride(0), scale_row=scales.stride(0), hidden=hidden, alpha=alpha,
            all_opacities=opacities, drawn=drawn, raw_geometry=geometry, raw_color=color, means=means,
            opacities=own_opacities, sizes=sizes, quats=quats, colors=colors,
        )  # fmt: skip
        ctx.save_for_backward(*inputs, *parameters, alpha, drawn, hidden, geometry, color)
        ctx.mark_non_differentiable(opacities, alpha, drawn)
        return *gaussians, opacities, alpha, drawn

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor | None, ...]:
        saved = ctx.saved_tensors
        center, positions, features, offsets, scales, masks = saved[:6]
        parameters, (alpha, drawn, hidden, geometry, color) = saved[6:18], saved[18:]
        to_features = features.new_empty(features.shape)
        to_offsets, to_scales = features.new_zeros(offsets.shape), features.new_zeros(scales.shape)
        to_masks = None if masks is None else torch.zeros_like(masks)
        to_parameters = [torch.empty_like(p) for p in parameters]
        by_means, by_opacities, by_sizes, by_quats, by_colors = (s.contiguous() for s in slopes[:5])
        face.heads_backward(
            center=center, positions=positions, features=features, offsets=offsets, scales=scales, masks=masks,
            **_named("", parameters), feature_row=features.stride(0), offset_row=offsets.stride(0),
            scale_row=scales.stride(0), hidden=hidden, alpha=alpha, drawn=drawn, raw_geometry=geometry,
            raw_color=color, by_means=by_means, by_opacities=by_opacities, by_sizes=by_sizes, by_quats=by_quats,
            by_colors=by_colors, scratch_alpha=torch.empty_like(alpha), scratch_geometry=torch.empty_like(geometry),
            scratch_color=torch.empty_like(color), to_features=to_features, to_offsets=to_offsets,
            to_scales=to_scales, to_masks=to_masks, **_named("to_", to_parameters),
        )  # fmt: skip
        return None, None, to_features, to_offsets, to_scales, to_masks, *to_parameters


@functools.cache
def _sizes(units: int) -> tuple[int, int]:
    """(anchors of a block, numbers of a row) of the hidden layers."""
    found = face.heads_sizes(units=units)
    return found.block, found.width


def _named(prefix: str, parameters: Sequence[Tensor]) -> dict[str, Any]:
    """Return the parameters, or their gradients, by the names of the fields."""
    found: dict[str, Any] = {"first": parameters[0::4], "first_bias": parameters[1::4]}
    for name, weight, bias in zip(("opacity", "geometry", "color"), parameters[2::4], parameters[3::4], strict=True):
        found |= {name: weight, f"{name}_bias": bias}
    return {f"{prefix}{name}": value for name, value in found.items()}
