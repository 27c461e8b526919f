"""Kernels of CUDA for planes in training: their bits under spatial models, and features at kept sites."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from sw_codecs.context.fast.ordered_sums import largest_for_sums
from sw_codecs.fast import cuda_face
from sw_codecs.native import CODECS

MOST_SIZES = 4
"""Planes of so many sizes are taken: `kScales` of kernels/plane_bits.h and kernels/triplane.h."""


SUMS = 1060
"""Numbers that are summed up for each orientation: `kSums` of kernels/plane_bits.h."""


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
    planes, parameters = [plane.contiguous() for plane in planes], parameters.contiguous()
    k, channels = planes[0].shape[:2]
    sizes: Any = {
        "heights": [plane.shape[2] for plane in planes], "widths": [plane.shape[3] for plane in planes],
        "scales": len(planes), "orientations": k, "channels": channels,
    }  # fmt: skip
    if any(plane.shape[:2] != (k, channels) for plane in planes):
        raise RuntimeError(f"planes must be [{k},{channels},H,W], got {[list(plane.shape) for plane in planes]}")
    parts = cuda_face.plane_bits_sizes(**sizes, device=parameters.get_device()).parts
    summed = parameters.new_empty(k, parts, SUMS)
    to_planes = [torch.zeros_like(plane) for plane in planes] if planes_learn else []
    in_order = to_planes if torch.are_deterministic_algorithms_enabled() else []
    ordered = [plane.new_empty(k * 192 * -(-plane[0].numel() // 32)) for plane in in_order]
    cuda_face.plane_bits(
        planes=planes, **sizes, parameters=parameters, to_planes=to_planes, ordered=ordered,
        ordered_counts=[each.numel() for each in ordered], partial=summed,
    )  # fmt: skip
    return summed.sum(1), to_planes


def sampled(cells: Tensor, weights: Tensor, planes: Sequence[Tensor], gain: float) -> Tensor:
    """Features [n, sizes * 3 C] of planes [3,C,H,W] at sites, as of `plane_sites.PlaneSites`; no gradient.

    gain    planes are rounded to multiples of 1 / gain; 0: they are not
    """
    planes = [plane.contiguous() for plane in planes]
    channels, places = planes[0].shape[1], [plane.shape[2] * plane.shape[3] for plane in planes]
    features = weights.new_empty(len(cells), len(planes) * 3 * channels)
    cuda_face.triplane_lookup(
        cells=cells.contiguous(), weights=weights.contiguous(), planes=planes, places=places, channels=channels,
        gain=gain, tables=_tables(planes, weights.new_empty), features=features,
    )  # fmt: skip
    return features


def sampled_backward(cells: Tensor, weights: Tensor, slopes: Tensor, planes: Sequence[Tensor]) -> list[Tensor]:
    """Derivatives by the planes, from those by the features [n, sizes * 3 C]. Fastest if neighbours follow each other.

    planes      for their shapes alone
    """
    channels, places = planes[0].shape[1], [plane.shape[2] * plane.shape[3] for plane in planes]
    slopes, largest = slopes.contiguous(), largest_for_sums(slopes)
    found = [slopes.new_empty(plane.shape) for plane in planes]
    zeros = _tables(planes, partial(slopes.new_zeros, dtype=torch.float32 if largest is None else torch.int64))
    cuda_face.triplane_backward(
        cells=cells.contiguous(), weights=weights.contiguous(), slopes=slopes, places=places, channels=channels,
        largest=largest, tables=zeros if largest is None else [], sums=[] if largest is None else zeros,
        to_planes=found,
    )  # fmt: skip
    return found


def _tables(planes: Sequence[Tensor], make: Callable[..., Tensor]) -> list[Tensor]:
    """Room for each plane [3,C,H,W] as a table of rows of its channels. RuntimeError if they differ in C."""
    channels = planes[0].shape[1]
    if any(plane.shape[:2] != (3, channels) for plane in planes):
        raise RuntimeError(f"planes must be [3,{channels},H,W], got {[list(plane.shape) for plane in planes]}")
    return [make(3 * plane.shape[2] * plane.shape[3], channels) for plane in planes]
