"""Quantizer `uniform`: per-channel affine, a range cut into 2^bits equal steps or a given step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from splatwizard_core.api import ShapeError
from sw_codecs.quantizers.side_information import finite_values, floats, integers, within
from sw_codecs.quantizers.straight_through import straight_through

MAX_BITS = 24


class Uniform:
    """x [N, C] (or [N]) -> indices 0 .. 2^bits - 1 per channel, lattice x^ = low + index * step.

    bits        1..24, one number or one per channel
    low, high   the range, a number or one per channel; None: the minimum and maximum of what is encoded.
                Values outside are clamped to it.
    noise       forward adds uniform noise of one step instead of rounding (for training with a rate term)

    `forward` uses the same lattice, its gradient is 1 inside the range and 0 outside. Arithmetic is float64, results
    float32. Unlike that of `fake-quant` the lattice starts at `low` itself, not at a multiple of the step: both ends of
    the range are lattice points.
    """

    def __init__(
        self,
        bits: int | Sequence[int] = 8,
        *,
        low: float | Sequence[float] | None = None,
        high: float | Sequence[float] | None = None,
        noise: bool = False,
    ) -> None:
        self.bits = np.asarray(bits)
        if not np.issubdtype(self.bits.dtype, np.integer) or self.bits.min() < 1 or self.bits.max() > MAX_BITS:
            raise ValueError(f"bits are {bits}, must be integers in 1..{MAX_BITS}")
        if low is not None and high is not None and not (np.asarray(low) <= np.asarray(high)).all():
            raise ValueError(f"the range {low} .. {high} ends before it starts")
        self.low, self.high, self.noise = low, high, noise

    def _lattice(self, x: Tensor, *, check: bool = False) -> tuple[Tensor, Tensor, Tensor]:
        """(low, step, largest index), each [C] float64 on the device of x."""
        columns = _columns(x)
        check = check or x.device.type == "cpu"  # a look at a GPU waits for it, which a training step should not
        if check and columns.numel() and not bool(torch.isfinite(columns).all()):
            raise ValueError("values to quantize must be finite")
        channels = columns.shape[1]
        empty = columns.shape[0] == 0
        ends = []
        for given, reduce in ((self.low, torch.amin), (self.high, torch.amax)):
            if given is not None:
                end = torch.as_tensor(given, dtype=torch.float64, device=x.device).expand(channels)
            elif empty:
                end = torch.zeros(channels, dtype=torch.float64, device=x.device)
            else:
                end = reduce(columns.detach(), dim=0).to(torch.float64)
            ends.append(end)
        # The lattice is stored as float32, so it is computed from what will be read back.
        low = ends[0].to(torch.float32).to(torch.float64)
        levels = torch.as_tensor(2.0**self.bits - 1, dtype=torch.float64, device=x.device).expand(channels)
        step = ((ends[1] - low) / levels).to(torch.float32).to(torch.float64)
        if check and not bool(torch.isfinite(low).all() and torch.isfinite(step).all()):
            raise ValueError("the range to quantize does not fit float32")
        return low, torch.where(step > 0, step, torch.ones_like(step)), levels

    def forward(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """x^ of the shape of x; differentiable."""
        low, step, levels = self._lattice(x)
        columns = _columns(x)
        bottom, top = low.to(x.dtype), (low + levels * step).to(x.dtype)
        with torch.no_grad():
            if self.noise:
                noise = torch.rand(columns.shape, generator=generator, device=x.device, dtype=x.dtype)
                moved = columns + (noise - 0.5) * step.to(x.dtype)
            else:
                index = ((columns.to(torch.float64) - low) / step).round()
                moved = (low + index * step).to(x.dtype)
            moved = moved.clamp(bottom, top)
            inside = (columns >= bottom) & (columns <= top)
        return straight_through(columns, moved, inside).reshape(x.shape)

    __call__ = forward

    def encode(self, x: Tensor) -> tuple[Tensor, dict[str, Any]]:
        """Indices int64 of the shape of x, and {"low", "step"} float32 [C], {"bits"} uint8 [C] as numpy arrays.

        Raises ValueError for values that are not finite or whose range float32 cannot hold.
        """
        low, step, levels = self._lattice(x, check=True)
        index = ((_columns(x).detach().to(torch.float64) - low) / step).round().clamp(torch.zeros_like(levels), levels)
        channels = index.shape[1]
        side = {
            "low": low.cpu().numpy().astype(np.float32),
            "step": step.cpu().numpy().astype(np.float32),
            "bits": np.broadcast_to(self.bits, channels).astype(np.uint8),
        }
        return index.to(torch.int64).reshape(x.shape), side

    @staticmethod
    def decode(symbols: Tensor, side: dict[str, Any]) -> Tensor:
        """x^ float32 of the shape of `symbols`. Raises BitstreamError if the side information does not fit."""
        index = _columns(symbols)
        shape = (index.shape[1],)
        low, step = floats(side, "low", shape), floats(side, "step", shape, positive=True)
        bits = integers(side, "bits", shape, 1, MAX_BITS)
        levels = torch.as_tensor(2**bits - 1, device=symbols.device)
        index = within(index, 0, levels)
        low64, step64 = (torch.as_tensor(array, device=symbols.device) for array in (low, step))
        return finite_values(low64 + index.to(torch.float64) * step64).reshape(symbols.shape)


def _columns(x: Tensor) -> Tensor:
    """[N] as [N, 1], [N, C] as it is."""
    if x.ndim not in (1, 2):
        raise ShapeError(f"a quantizer takes [N] or [N, C], not {list(x.shape)}")
    return x if x.ndim == 2 else x[:, None]
