"""Kernels that spawn Gaussians: forward and backward take one pass over memory each.

On the CPU networks and Gaussians are one kernel (`heads`); on CUDA, and where positions learn, networks are one node
(`networks`), and the Gaussians with opacity > 0 another.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from splatwizard_native import Repeated
from sw_anchors import cuda_face, face
from sw_anchors.fast import heads
from sw_anchors.fast.kernels import fit_kernels, room_for_gaussians, without_gaps, zeros_together
from sw_anchors.fast.networks import network_outputs
from sw_anchors.neural_gaussians import Networks, NeuralGaussians


def fits(positions: Tensor, *others: Tensor | None) -> bool:
    """Whether there are kernels for anchors at `positions` and the other float32 tensors of `spawn`; loads them."""
    return fit_kernels(positions, *others)


def spawn(
    center: Tensor,
    positions: Tensor,
    features: Tensor,
    offsets: Tensor,
    scales: Tensor,
    masks: Tensor | None,
    networks: Networks,
) -> NeuralGaussians:
    """Fast version of `neural_gaussians.spawn`. Waits for the device once, for the number of Gaussians."""
    if heads.fits(positions, networks):
        return heads.spawn(center, positions, features, offsets, scales, masks, networks)
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
    opacities, drawn = drawn_of(alpha.detach(), None if masks is None else masks.detach())
    found = _Gaussians.apply(drawn, alpha, geometry, color, positions, offsets, scales, masks)  # type: ignore[no-untyped-call]
    return NeuralGaussians(*found, opacities, alpha.detach(), drawn)


def drawn_of(alpha: Tensor, masks: Tensor | None) -> tuple[Tensor, Tensor]:
    """(opacities [V,k] after masks, places [M] int64 among V k where they are > 0). Waits for the device."""
    opacities = alpha if masks is None else alpha * masks
    return opacities, torch.nonzero(opacities.view(-1) > 0).squeeze(1)


class AlikeGaussians:
    """Spawns Gaussians from outputs of networks that are alike at each step of a training, unknown to autograd.

    The first call on a GPU is checked. Outputs are those of `network_outputs`, positions [V,3], offsets [V,k,3] and
    scales [V,6], of which rows are without gaps, and masks [V,k].
    """

    def __init__(self) -> None:
        self._there, self._back = Repeated(cuda_face, "spawn"), Repeated(cuda_face, "spawn_backward")

    def spawned(self, drawn: Tensor, given: Sequence[Tensor]) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Return means, opacities, scales, quaternions and colours of the Gaussians `drawn`."""
        means, opacities, sizes, quats, colors = found = room_for_gaussians(drawn.shape[0], given[0])
        to = {"means": means, "opacities": opacities, "sizes": sizes, "quats": quats, "colors": colors}
        if drawn.is_cuda:
            self._there(lambda: _rows_of(given), **_tensors_of(given, drawn), **to, count=drawn.shape[0])
        else:
            face.spawn(**_named(given, drawn), **to)
        return found

    def add_gradients(
        self, drawn: Tensor, given: Sequence[Tensor], slopes: Sequence[Tensor], into: Sequence[Tensor]
    ) -> None:
        """Write gradients of what is given, but the positions, into zeros; slopes: of what was spawned, contiguous."""
        of_means, of_opacities, of_sizes, of_quats, of_colors = slopes
        to_alpha, to_geometry, to_color, to_offsets, to_scales, to_masks = into
        both = {
            "by_means": of_means, "by_opacities": of_opacities, "by_sizes": of_sizes, "by_quats": of_quats,
            "by_colors": of_colors, "to_alpha": to_alpha, "to_geometry": to_geometry, "to_color": to_color,
            "to_offsets": to_offsets, "to_scales": to_scales, "to_masks": to_masks,
        }  # fmt: skip
        ordered = torch.are_deterministic_algorithms_enabled()
        if drawn.is_cuda:
            self._back(
                lambda: _rows_of(given), **_tensors_of(given, drawn), **both, count=drawn.shape[0], ordered=ordered
            )
        else:
            face.spawn_backward(**_named(given, drawn), **both, ordered=ordered)


class _Gaussians(torch.autograd.Function):
    """Means, opacities, scales, quaternions and colours of the Gaussians `drawn`, in one pass each way."""

    @staticmethod
    def forward(ctx: Any, drawn: Tensor, *inputs: Tensor | None) -> tuple[Tensor, ...]:
        # Offsets and scales may be columns of a matrix: of these a row must be without gaps.
        given = without_gaps(inputs, (None, None, None, None, (3, 1), (1,), None))
        ctx.save_for_backward(*given, drawn)
        means, opacities, sizes, quats, colors = found = room_for_gaussians(len(drawn), given[0])
        operations = cuda_face if drawn.is_cuda else face
        operations.spawn(
            **_named(given, drawn), means=means, opacities=opacities, sizes=sizes, quats=quats, colors=colors
        )
        return found

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor | None, ...]:
        positions_learn, has_masks = ctx.needs_input_grad[4], ctx.saved_tensors[6] is not None
        *given, drawn = ctx.saved_tensors
        contiguous = [slope.contiguous() for slope in slopes]
        alpha, geometry, color, positions, offsets, scales, masks = given
        learning = alpha, geometry, color, offsets, scales, masks, positions if positions_learn else None
        shapes = [t.shape for t in learning if t is not None]
        zeros = zeros_together(shapes, drawn) if drawn.is_cuda else [alpha.new_zeros(shape) for shape in shapes]
        to_alpha, to_geometry, to_color, to_offsets, to_scales, *rest = zeros
        to_masks = rest.pop(0) if has_masks else None
        to_positions = rest.pop(0) if positions_learn else None
        means, opacities, sizes, quats, colors = contiguous
        operations = cuda_face if drawn.is_cuda else face
        operations.spawn_backward(
            **_named(given, drawn),
            by_means=means, by_opacities=opacities, by_sizes=sizes, by_quats=quats, by_colors=colors,
            to_alpha=to_alpha, to_geometry=to_geometry, to_color=to_color, to_offsets=to_offsets,
            to_scales=to_scales, to_masks=to_masks, to_positions=to_positions,
            ordered=torch.are_deterministic_algorithms_enabled(),
        )  # fmt: skip
        return None, to_alpha, to_geometry, to_color, to_positions, to_offsets, to_scales, to_masks


def _named(given: Sequence[Tensor | None], drawn: Tensor) -> dict[str, Any]:
    """Arguments of both operations."""
    return _tensors_of(given, drawn) | _rows_of(given)


def _tensors_of(given: Sequence[Tensor | None], drawn: Tensor) -> dict[str, Any]:
    alpha, geometry, color, positions, offsets, scales, masks = given
    return {
        "alpha": alpha, "geometry": geometry, "color": color, "positions": positions, "offsets": offsets,
        "scales": scales, "masks": masks, "drawn": drawn,
    }  # fmt: skip


def _rows_of(given: Sequence[Tensor | None]) -> dict[str, Any]:
    offsets, scales = given[4:6]
    assert offsets is not None
    assert scales is not None
    return {"offset_row": offsets.stride(0), "scale_row": scales.stride(0)}
