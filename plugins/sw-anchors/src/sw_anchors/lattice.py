"""16-bit lattice of anchor positions, used in training and in the file.

On an axis with bounds lo, hi and step d = (hi - lo) / 65535, position x has the code v = floor((x - lo) / d) and
decodes to v d + lo. Floor, not rounding, as the published methods train with it. Arithmetic is float64 on stored
float32 bounds, one operation at a time, so codes decode to the same positions on every machine. Source: HAC (arXiv
2403.14530), without the 1e-6 that its code adds to d: so the normalised coordinate of a code is v / 65535.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

BITS = 16
TOP = (1 << BITS) - 1
FLAT_AXIS_STEP = 1e-6  # of an axis without extent, world units

Margin = Literal["origin", "extent", "none"]
"""Margin of the lattice bounds around the anchors, see `bounds_of`."""


def bounds_of(positions: Tensor, margin: Margin = "none") -> Tensor:
    """Return lattice bounds [2,3] float32 (low, high) for positions [N,3], N > 0.

    margin  "none"; "extent": 10 % of the extent at each end; "origin": a fifth of each end's distance from the origin,
            as in HAC (no margin if an end is 0, a large one if the scene is far from the origin)
    """
    low, high = positions.detach().amin(dim=0), positions.detach().amax(dim=0)
    if margin == "origin":
        low = torch.where(low < 0, low * 1.2, low * 0.8)
        high = torch.where(high > 0, high * 1.2, high * 0.8)
    elif margin == "extent":
        low, high = low - 0.1 * (high - low), high + 0.1 * (high - low)
    return torch.stack([low, high]).to(torch.float32)


def position_codes(positions: Tensor, bounds: Tensor) -> Tensor:
    """Return codes [N,3] int64 in 0..65535; positions outside the bounds are clamped."""
    low, step = low_and_step(bounds)
    return torch.floor((positions.detach().to(torch.float64) - low) / step).clamp(0, TOP).to(torch.int64)


def coded_positions(codes: Tensor, bounds: Tensor) -> Tensor:
    """Return positions [N,3] float32, world units, of lattice codes."""
    low, step = low_and_step(bounds)
    return (codes.to(torch.float64) * step + low).to(torch.float32)


def low_and_step(bounds: Tensor) -> tuple[Tensor, Tensor]:
    """Return low end [3] and step [3] of the lattice, float64, world units; FLAT_AXIS_STEP on an axis of no extent."""
    low, high = bounds.to(torch.float64).unbind(0)
    step = (high - low) / TOP
    return low, torch.where(step > 0, step, torch.full_like(step, FLAT_AXIS_STEP))
