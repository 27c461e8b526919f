"""Kernels of CUDA for planes in training: their bits under spatial models, and features at kept sites."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from sw_codecs.context.fast.ordered_sums import largest_for_sums
from sw_codecs.native import CODECS

MOST_SIZES = 4
"""Planes of so many sizes are taken: `kScales` of kernels/plane_bits.h and kernels/triplane.h."""


MOST_CELLS = 65_535 * 32
"""Of a plane, H x W: it is transposed in tiles of 32 cells, one in each row of a CUDA grid, which has 65,535 at most.
"""


def fit_kernels(planes: Sequence[Tensor]) -> bool:
    """Whether there are kernels for these planes [K,C,H,W], one for each size: float32 on CUDA; loads them.

    Some of their sums are atomic; the same in any order where torch is asked for deterministic algorithms.
    """
    if not 0 < len(planes) <= MOST_SIZES or not all(p.is_cuda and p.dtype == torch.float32 for p in planes):
        return False
    if any(p.numel() >= 1 << 31 or p.shape[-2] * p.shape[-1] > MOST_CELLS for p in planes):
        return False
    return CODECS.has_cuda()


def has_tensor_cores(tensor: Tensor) -> bool:
    """Whether its GPU multiplies bfloat16 on tensor cores, as `plane_bits` does: capability 8.0 (Ampere) or later."""
    return torch.cuda.get_device_capability(tensor.device) >= (8, 0)


def plane_bits(planes: Sequence[Tensor], parameters: Tensor, *, planes_learn: bool) -> tuple[Tensor, list[Tensor]]:
    """Bits of planes [K,C,H,W] per size and all derivatives, in one pass.

    parameters  [K,1058] of each orientation's `SpatialAr`: weight and bias of each layer

    Returns ([K,1060]: derivatives by the parameters, the bits, 0; derivatives by the planes of each size, or none).
    """
    found: tuple[Tensor, list[Tensor]] = torch.ops.sw_codecs.plane_bits(
        [plane.contiguous() for plane in planes], parameters.contiguous(), planes_learn,
        torch.are_deterministic_algorithms_enabled(),
    )  # fmt: skip
    return found


def sampled(cells: Tensor, weights: Tensor, planes: Sequence[Tensor], gain: float) -> Tensor:
    """Features [n, sizes * 3 C] of planes [3,C,H,W] at sites, as of `plane_sites.PlaneSites`; no gradient.

    gain    planes are rounded to multiples of 1 / gain; 0: they are not
    """
    found: Tensor = torch.ops.sw_codecs.triplane_lookup(
        cells.contiguous(), weights.contiguous(), [plane.contiguous() for plane in planes], gain
    )
    return found


def sampled_backward(cells: Tensor, weights: Tensor, slopes: Tensor, planes: Sequence[Tensor]) -> list[Tensor]:
    """Derivatives by the planes, from those by the features [n, sizes * 3 C]. Fastest if neighbours follow each other.

    planes      for their shapes alone
    """
    found: list[Tensor] = torch.ops.sw_codecs.triplane_backward(
        cells.contiguous(), weights.contiguous(), slopes.contiguous(), list(planes), largest_for_sums(slopes)
    )
    return found
