"""Quantizer `position-grid`: positions on a grid of 2^bits points an axis over a box."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from splatwizard_core.api import BitstreamError, ShapeError
from sw_codecs.side_information import finite_values, floats, integers, within
from sw_codecs.straight_through import straight_through

MAX_BITS = 21  # what a Morton code holds
FLAT = 1e-6  # step of an axis without extent; also what `delta_eps` adds

Bound = float | Sequence[float] | Tensor | None


class PositionQuantizer:
    """v = clamp(floor((x - low) / step), 0, 2^bits - 1), x^ = v step + low; step = (high - low) / (2^bits - 1).

    bits        1..21
    low, high   the box, a number or one per axis; None: the minimum and maximum of what is quantized, per axis
    floor       True as HAC trains with it, biased by half a step; False rounds half to even
    delta_eps   step = (high - low) / (2^bits - 1) + 1e-6, as HAC's authors' code: for parity only. A scene 2 units
                wide gets steps 3 % too long, and v / (2^bits - 1) is then not the place within the box.

    x is [N, 3], or [N, C]. An axis with high = low has step 1e-6 and only v = 0. `floor` finds the last grid point,
    as a decoder computes it, that is not beyond x: a position that is one stays where it is, exactly. Grids finer than
    float32 (low and high far from 0) decode to few distinct values. Source: HAC (arXiv 2403.14530), anchor positions.
    """

    def __init__(
        self, bits: int = 16, *, low: Bound = None, high: Bound = None, floor: bool = True, delta_eps: bool = False
    ) -> None:
        if not 1 <= bits <= MAX_BITS:
            raise ValueError(f"bits are {bits}, must be in 1..{MAX_BITS}")
        self.bits, self.low, self.high, self.floor, self.delta_eps = bits, low, high, floor, delta_eps

    def forward(self, x: Tensor) -> Tensor:
        """x^ of the shape of x, with gradient 1 (also where the box clamps)."""
        low, step = self._grid(x)
        return straight_through(x, _value(self._index(x, low, step), low, step))

    __call__ = forward

    def encode(self, x: Tensor) -> tuple[Tensor, dict[str, Any]]:
        """v int64 [N, C], and {"low"} float32 [C], {"step"} float64 [C], {"bits"} uint8 [].

        Raises ValueError for positions or a box that are not finite, or a box that ends before it starts.
        """
        if x.numel() and not bool(torch.isfinite(x).all()):
            raise ValueError("values to quantize must be finite")
        low, step = self._grid(x, check=True)
        side = {
            "low": low.cpu().numpy().astype(np.float32),
            "step": step.cpu().numpy(),
            "bits": np.uint8(self.bits),
        }
        return self._index(x, low, step).to(torch.int64), side

    @staticmethod
    def decode(symbols: Tensor, side: dict[str, Any]) -> Tensor:
        """x^ [N, C] float32. Raises BitstreamError if the side information does not fit."""
        if symbols.ndim != 2:
            raise BitstreamError(f"grid positions have shape {list(symbols.shape)}, must be [N, axes]")
        bits, axes = int(integers(side, "bits", (), 1, MAX_BITS)), (symbols.shape[1],)
        low, step = (
            torch.as_tensor(array, device=symbols.device)
            for array in (floats(side, "low", axes), floats(side, "step", axes, positive=True))
        )
        return finite_values(_value(within(symbols, 0, 2**bits - 1).to(torch.float64), low, step))

    def normalized(self, symbols: Tensor) -> Tensor:
        """v / (2^bits - 1), float64: the place within the box, 0..1, the same on every machine."""
        return symbols.to(torch.float64) / (2**self.bits - 1)

    def _grid(self, x: Tensor, *, check: bool = False) -> tuple[Tensor, Tensor]:
        """Low end and step of each axis, [C] float64; the low end is a float32."""
        if x.ndim != 2:
            raise ShapeError(f"positions have shape {list(x.shape)}", actual=x.shape, expected=("N", 3))
        ends = []
        for given, reduce in ((self.low, torch.amin), (self.high, torch.amax)):
            if given is not None:
                end = torch.as_tensor(given, dtype=torch.float64, device=x.device).detach().expand(x.shape[1])
            elif len(x) == 0:
                end = torch.zeros(x.shape[1], dtype=torch.float64, device=x.device)
            else:
                end = reduce(x.detach(), dim=0).to(torch.float64)
            ends.append(end)
        low, high = ends[0].to(torch.float32).to(torch.float64), ends[1]
        # A low end between two float32 values may round past a high end that equals it.
        low = torch.where((low > high) & (ends[0] <= high), high, low)
        if (check or x.device.type == "cpu") and not bool(  # a training step on a GPU should not wait for a look
            (low <= high).all() and torch.isfinite(low).all() and torch.isfinite(high.to(torch.float32)).all()
        ):
            raise ValueError("the box of the positions is not finite, or ends before it starts")
        step = (high - low) / (2**self.bits - 1)
        return low, torch.where(high == low, FLAT, step + FLAT if self.delta_eps else step)

    @torch.no_grad()
    def _index(self, x: Tensor, low: Tensor, step: Tensor) -> Tensor:
        """v as float64."""
        place = (x.to(torch.float64) - low) / step
        top = 2**self.bits - 1
        if not self.floor:
            return torch.round(place).clamp(0, top)
        index = torch.floor(place).clamp(0, top)
        # The quotient may land just below a grid point whose decoded value x is.
        rounded = x.to(torch.float32).to(torch.float64)
        following = (index + 1).clamp(max=top)
        return torch.where(_value(following, low, step).to(torch.float32) <= rounded, following, index)


def _value(index: Tensor, low: Tensor, step: Tensor) -> Tensor:
    return index * step + low
