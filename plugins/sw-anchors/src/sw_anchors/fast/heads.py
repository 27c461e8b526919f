"""Anchor networks and Gaussian spawning fused: one CPU kernel each for forward and backward.

Hidden layers of all three networks are one matrix product. The covariance and colour networks compute only the outputs
of rendered Gaussians, fewer than half (benchmarks/train_anchors.py).
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from sw_anchors.fast.kernels import without_gaps
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
        inputs = without_gaps(
            (center, positions, features, offsets, scales, masks), (None, None, (1,), (3, 1), (1,), None)
        )
        found = torch.ops.sw_anchors.heads(*inputs, [p.contiguous() for p in parameters])
        gaussians, (opacities, *saved) = found[:5], found[5:]
        ctx.save_for_backward(*inputs, *parameters, *saved)
        alpha, drawn = saved[:2]
        ctx.mark_non_differentiable(opacities, alpha, drawn)
        return *gaussians, opacities, alpha, drawn

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor | None, ...]:
        saved = ctx.saved_tensors
        inputs, parameters, rest = saved[:6], saved[6:18], saved[18:]
        features, offsets, scales, masks, *to_parameters = torch.ops.sw_anchors.heads_backward(
            *inputs, [p.contiguous() for p in parameters], list(rest), [s.contiguous() for s in slopes[:5]]
        )
        return None, None, features, offsets, scales, None if inputs[5] is None else masks, *to_parameters
