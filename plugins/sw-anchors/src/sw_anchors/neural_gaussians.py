"""Neural Gaussians of a view, from what the networks say of anchors: those with opacity > 0.

In float32 kernels decode each Gaussian, and its gradient, in one pass, on the CPU together with the networks; torch
operations everywhere else.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from sw_anchors.fast.fused_heads import fits_kernel, spawn_by_kernel
from sw_anchors.fast.view_networks import Networks, network_outputs
from sw_anchors.native import ANCHORS

GEOMETRY = 7
"""Outputs of the covariance network per Gaussian: 3 scale factors, 4 quaternion components."""
_SHORTEST = 1e-12  # floor of a quaternion's norm, that of torch.nn.functional.normalize


@dataclass(frozen=True)
class NeuralGaussians:
    """M Gaussians with opacity > 0 of V anchors with k offsets each.

    means, opacities, scales, quats, colors     [M,...] as in GaussianInputs; differentiable
    all_opacities   [V,k] in (-1,1), no gradient
    alphas          [V,k] the same before masks
    drawn           [M] int64, which of the V * k they are
    """

    means: Tensor
    opacities: Tensor
    scales: Tensor
    quats: Tensor
    colors: Tensor
    all_opacities: Tensor
    alphas: Tensor
    drawn: Tensor


def spawn(
    center: Tensor,
    positions: Tensor,
    features: Tensor,
    offsets: Tensor,
    scales: Tensor,
    masks: Tensor | None,
    networks: Networks,
) -> NeuralGaussians:
    """Decode the Gaussians of V anchors for a camera at `center` [3], which gets no gradient.

    positions [V,3], features [V,F], offsets [V,k,3], scales [V,6], masks [V,k] or None: as in AnchorAttributes

    Waits for the device once, for M.
    """
    if fits_kernel(positions, (center, features, offsets, scales, masks), networks):
        return NeuralGaussians(*spawn_by_kernel(center, positions, features, offsets, scales, masks, networks))
    outputs = network_outputs(center, positions, features, networks)
    return visible_gaussians(*outputs, positions, offsets, scales, masks)


def visible_gaussians(
    alpha: Tensor,
    geometry: Tensor,
    color: Tensor,
    positions: Tensor,
    offsets: Tensor,
    scales: Tensor,
    masks: Tensor | None,
) -> NeuralGaussians:
    """Decode the Gaussians of opacity > 0 from `network_outputs`; other arguments, and the wait, as of `spawn`."""
    opacities = alpha.detach() if masks is None else alpha.detach() * masks.detach()
    drawn = torch.nonzero(opacities.view(-1) > 0).squeeze(1)  # [M]
    inputs = (alpha, geometry, color, positions, offsets, scales, masks)
    node = _ByKernel if _has_kernel(inputs) else _ByTorch
    found = node.apply(drawn, *inputs)  # type: ignore[no-untyped-call]
    return NeuralGaussians(*found, opacities, alpha.detach(), drawn)


def _has_kernel(inputs: tuple[Tensor | None, ...]) -> bool:
    if any(t is not None and t.dtype != torch.float32 for t in inputs):
        return False
    alpha = inputs[0]
    assert alpha is not None
    return ANCHORS.has_cuda() if alpha.is_cuda else alpha.device.type == "cpu" and ANCHORS.try_load()


class _ByKernel(torch.autograd.Function):
    """Means, opacities, scales, quaternions and colours of the Gaussians `drawn`, in one pass each way."""

    @staticmethod
    def forward(ctx: Any, drawn: Tensor, *inputs: Tensor | None) -> tuple[Tensor, ...]:
        # Offsets and scales may be columns of a matrix: of these a row must be without gaps.
        gaps = (None, None, None, None, (3, 1), (1,), None)
        given = tuple(
            t if t is None or (inner is not None and t.stride()[1:] == inner) else t.contiguous()
            for t, inner in zip(inputs, gaps, strict=True)
        )
        ctx.save_for_backward(*given, drawn)
        return tuple(torch.ops.sw_anchors.spawn(*given, drawn))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor | None, ...]:
        positions_learn, has_masks = ctx.needs_input_grad[4], ctx.saved_tensors[6] is not None
        contiguous = [slope.contiguous() for slope in slopes]
        *found, to_masks, to_positions = torch.ops.sw_anchors.spawn_backward(
            *ctx.saved_tensors, contiguous, positions_learn, torch.are_deterministic_algorithms_enabled()
        )
        to_alpha, to_geometry, to_color, to_offsets, to_scales = found
        return (
            None, to_alpha, to_geometry, to_color, to_positions if positions_learn else None, to_offsets, to_scales,
            to_masks if has_masks else None,
        )  # fmt: skip


class _ByTorch(torch.autograd.Function):
    """The same in torch operations."""

    @staticmethod
    def forward(ctx: Any, drawn: Tensor, *inputs: Tensor) -> tuple[Tensor, ...]:
        alpha, geometry, color, positions, offsets, scales, masks = inputs
        owner = torch.div(drawn, alpha.shape[1], rounding_mode="floor")  # [M]
        opacities = (alpha if masks is None else alpha * masks).reshape(-1).index_select(0, drawn)
        geometry = geometry.reshape(-1, GEOMETRY).index_select(0, drawn)
        color = color.reshape(-1, 3).index_select(0, drawn).sigmoid_()
        own_scales = scales.index_select(0, owner)  # [M,6]
        own_offsets = offsets.reshape(-1, 3).index_select(0, drawn)
        means = torch.addcmul(positions.index_select(0, owner), own_offsets, own_scales[:, :3])
        factors = torch.sigmoid(geometry[:, :3])
        # Noise or rounding may take a base scale through zero: a Gaussian of scale -s is that of scale s.
        sizes = own_scales[:, 3:].abs() * factors
        quats = geometry[:, 3:]
        norms = torch.linalg.vector_norm(quats, dim=1, keepdim=True).clamp_min_(_SHORTEST)
        quats = quats / norms
        ctx.save_for_backward(alpha, masks, drawn, own_scales, own_offsets, factors, sizes, quats, norms, color)
        return means, opacities, sizes, quats, color

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, to_means: Tensor, to_opacities: Tensor, to_sizes: Tensor, to_quats: Tensor, to_color: Tensor
    ) -> tuple[Tensor | None, ...]:
        alpha, masks, drawn, own_scales, own_offsets, factors, sizes, quats, norms, color = ctx.saved_tensors
        n, k = alpha.shape
        positions_learn = ctx.needs_input_grad[4]
        columns = [
            to_means * own_scales[:, :3],  # of the offsets: 0 to 2
            to_means * own_offsets,  # of the scales: 3 to 8
            to_sizes * factors * own_scales.sign()[:, 3:],
            to_sizes * sizes * (1 - factors),  # of the covariance network: 9 to 15
            (to_quats - quats * (quats * to_quats).sum(dim=1, keepdim=True)) / norms,
            to_color * color * (1 - color),  # of the colour network: 16 to 18
            to_opacities[:, None],  # 19
        ]
        if positions_learn:
            columns.append(to_means)  # 20 to 22
        # Each Gaussian was drawn once, so its row is written, not added to.
        source = torch.cat(columns, dim=1)
        dense = source.new_zeros(n * k, source.shape[1]).index_copy_(0, drawn, source)
        by_anchor = dense.view(n, k, source.shape[1])
        to_alpha = by_anchor[:, :, 19]
        return (
            None,
            to_alpha if masks is None else to_alpha * masks,
            dense[:, 9:16].reshape(n, GEOMETRY * k),
            dense[:, 16:19].reshape(n, 3 * k),
            by_anchor[:, :, 20:].sum(dim=1) if positions_learn else None,
            dense[:, :3].reshape(n, k, 3),
            by_anchor[:, :, 3:9].sum(dim=1),
            None if masks is None else to_alpha * alpha,
        )
