"""Neural Gaussians of a view, decoded from anchors by three networks: one node of the graph of derivatives.

A step of training is bound by how many operators the host has to launch, not by what they compute. Written out, this
was 215 operators forward and backward, each with a node of its own; here it is 90 in one (benchmarks/train_anchors.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

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
    networks: tuple[nn.Sequential, nn.Sequential, nn.Sequential],
    *,
    everything: bool = False,
) -> NeuralGaussians:
    """Decode the Gaussians of V anchors for a camera at `center` [3], which gets no gradient.

    positions [V,3], features [V,F], offsets [V,k,3], scales [V,6], masks [V,k] or None: as in AnchorAttributes
    networks    opacity (-> k), covariance (-> 7 k) and colour (-> 3 k), each Linear, ReLU, Linear on F + 4 inputs
    everything  decode all V * k Gaussians, whatever their opacity; else the device is waited for once, for M
    """
    parameters = [p for network in networks for layer in (network[0], network[2]) for p in (layer.weight, layer.bias)]
    found = _Spawn.apply(center, positions, features, offsets, scales, masks, everything, *parameters)  # type: ignore[no-untyped-call]
    return NeuralGaussians(*found)


class _Spawn(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        center: Tensor,
        positions: Tensor,
        features: Tensor,
        offsets: Tensor,
        scales: Tensor,
        masks: Tensor | None,
        everything: bool,
        *parameters: Tensor,
    ) -> tuple[Tensor, ...]:
        first, last = parameters[0::4], parameters[2::4]
        k = offsets.shape[1]
        toward = positions - center
        distance = torch.linalg.vector_norm(toward, dim=1, keepdim=True)
        direction = toward / distance
        context = torch.cat([features, direction, distance], dim=1)  # [V, F+4]
        weights = torch.cat(first)
        hidden = torch.addmm(torch.cat(parameters[1::4]), context, weights.t()).relu_()
        parts = torch.split(hidden, [len(w) for w in first], dim=1)
        pre, geometry, color = (
            torch.addmm(bias, part, weight.t())
            for bias, part, weight in zip(parameters[3::4], parts, last, strict=True)
        )

        alpha = pre.tanh_()  # [V,k]
        opacities = alpha if masks is None else alpha * masks
        flat = opacities.view(-1)
        drawn = torch.arange(flat.numel(), device=flat.device) if everything else torch.nonzero(flat > 0).squeeze(1)

        def picked(rows: Tensor) -> Tensor:  # of V k rows
            return rows if everything else rows.index_select(0, drawn)

        def owned(rows: Tensor) -> Tensor:  # of V rows
            if everything:
                return rows[:, None].expand(-1, k, -1).reshape(len(flat), -1)
            return rows.index_select(0, owner)

        owner = drawn if everything else torch.div(drawn, k, rounding_mode="floor")  # [M]
        geometry = picked(geometry.view(-1, GEOMETRY))
        color = picked(color.view(-1, 3)).sigmoid_()
        own_scales = owned(scales)  # [M,6]
        own_offsets = picked(offsets.reshape(-1, 3))
        means = torch.addcmul(owned(positions), own_offsets, own_scales[:, :3])
        factors = torch.sigmoid(geometry[:, :3])
        # Noise or rounding may take a base scale through zero: a Gaussian of scale -s is that of scale s.
        sizes = own_scales[:, 3:].abs() * factors
        quats = geometry[:, 3:]
        norms = torch.linalg.vector_norm(quats, dim=1, keepdim=True).clamp_min_(_SHORTEST)
        quats = quats / norms

        ctx.save_for_backward(
            direction, distance, context, weights, hidden, alpha, masks, drawn, own_scales, own_offsets, factors, sizes,
            quats, norms, color, *last,
        )  # fmt: skip
        ctx.widths, ctx.everything = [len(w) for w in first], everything
        unmasked = alpha.detach()
        ctx.mark_non_differentiable(opacities, unmasked, drawn)
        chosen = flat.clone() if everything else picked(flat)
        return means, chosen, sizes, quats, color, opacities, unmasked, drawn

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, to_means: Tensor, to_opacities: Tensor, to_sizes: Tensor, to_quats: Tensor, to_color: Tensor, *_: Any
    ) -> tuple[Tensor | None, ...]:
        (
            direction, distance, context, weights, hidden, alpha, masks, drawn, own_scales, own_offsets, factors, sizes,
            quats, norms, color, *last,
        ) = ctx.saved_tensors  # fmt: skip
        n, k = alpha.shape
        positions_learn = ctx.needs_input_grad[1]
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
        dense = torch.cat(columns, dim=1)
        if not ctx.everything:
            # Each Gaussian was drawn once, so its row is written, not added to.
            dense = dense.new_zeros(n * k, dense.shape[1]).index_copy_(0, drawn, dense)
        by_anchor = dense.view(n, k, dense.shape[1])

        to_alpha = by_anchor[:, :, 19]
        to_masks = to_alpha * alpha if ctx.needs_input_grad[5] else None
        if masks is not None:
            to_alpha = to_alpha * masks
        outputs = (
            to_alpha * (1 - alpha * alpha),
            dense[:, 9:16].reshape(n, GEOMETRY * k),
            dense[:, 16:19].reshape(n, 3 * k),
        )
        to_hidden = torch.empty_like(hidden)
        for part, out, weight in zip(torch.split(to_hidden, ctx.widths, dim=1), outputs, last, strict=True):
            torch.mm(out, weight, out=part)
        # In place: fresh memory costs a CPU more than the arithmetic.
        torch.ops.aten.threshold_backward.grad_input(to_hidden, hidden, 0, grad_input=to_hidden)
        to_weights = torch.split(torch.mm(to_hidden.t(), context), ctx.widths)
        to_biases = [part.sum(dim=0) for part in torch.split(to_hidden, ctx.widths, dim=1)]
        to_parameters: list[Tensor | None] = []
        for i, (out, part) in enumerate(zip(outputs, torch.split(hidden, ctx.widths, dim=1), strict=True)):
            to_parameters += [_aligned(to_weights[i]), to_biases[i], torch.mm(out.t(), part), out.sum(dim=0)]
        to_context = torch.mm(to_hidden, weights)

        to_positions = None
        if positions_learn:
            to_direction = to_context[:, -4:-1]
            along = (to_direction * direction).sum(dim=1, keepdim=True)
            to_positions = by_anchor[:, :, 20:].sum(dim=1) + (to_direction - direction * along) / distance
            to_positions += direction * to_context[:, -1:]
        return (
            None,
            to_positions,
            to_context[:, :-4],
            dense[:, :3].reshape(n, k, 3),
            by_anchor[:, :, 3:9].sum(dim=1),
            to_masks,
            None,
            *to_parameters,
        )


def _aligned(part: Tensor) -> Tensor:
    """The same with the alignment that the optimizer's kernel asks for (16 bytes), which rows of a matrix may lack."""
    return part if part.data_ptr() % 16 == 0 else part.clone()
