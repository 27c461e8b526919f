"""Quantizer `fake-quant`: affine with an integer zero point, its range observed while the model trains."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from splatwizard_core.api import BitstreamError, ShapeError
from sw_codecs.quantizers.side_information import finite_values, floats, integers, within
from sw_codecs.quantizers.straight_through import straight_through

MAX_BITS = 16
SMALLEST_STEP = 1e-12  # of a range without width
ZERO_LIMIT = 1 << 20  # a zero point beyond it would leave float32 no digits for the index: steps are longer then


class FakeQuantAffine(nn.Module):
    """q = clamp(round(x / s) + z, 0, 2^bits - 1), x^ = s (q - z); s = (max - min) / (2^bits - 1), z = round(-min / s).

    bits       1..16
    ema        None: the range only ever widens (running minimum and maximum); in 0..1: it follows, as
               ema * old + (1 - ema) * new, starting from the first tensor. 0.99 is usual
    channels   C: a range for each column of x [N, C]; None: one for all of x, which then may have any shape
    blocks     B: a range for each of B contiguous blocks of rows, the first N mod B of which have a row more
    zero       the range always includes 0. Without it (and with 0 far outside) steps are at least 2^-20 of the values

    `forward` first observes x, in training mode while `observing` is True, then quantizes; its gradient is 1 where
    round(x / s) + z is within the range, 0 outside. Evaluate after `eval()` or with `observing` False: the file must
    hold the range that was trained with. `encode` never observes; without an observed range it takes that of x.
    State (in state_dict): minimum and maximum [B, C], inf and -inf where nothing was seen; it follows x to its device.

    Signed integers are these minus 2^(bits-1). Source: Jacob et al. (arXiv 1712.05877); with 8 bits and ema 0.99 in
    C3DGS (arXiv 2401.02436), running and in blocks in MesonGS (arXiv 2409.09756).
    """

    minimum: Tensor
    maximum: Tensor

    def __init__(
        self,
        bits: int = 8,
        *,
        ema: float | None = None,
        channels: int | None = None,
        blocks: int = 1,
        zero: bool = True,
    ) -> None:
        super().__init__()
        if not 1 <= bits <= MAX_BITS or blocks < 1 or (ema is not None and not 0 <= ema < 1):
            raise ValueError(f"bits {bits}, blocks {blocks}, ema {ema}: must be 1..{MAX_BITS}, >= 1, in 0..1 or None")
        self.bits, self.ema, self.channels, self.blocks, self.zero = bits, ema, channels, blocks, zero
        self.observing = True
        self.register_buffer("minimum", torch.full((blocks, channels or 1), torch.inf))
        self.register_buffer("maximum", torch.full((blocks, channels or 1), -torch.inf))

    def reset(self) -> None:
        """Forget the range."""
        self.minimum.fill_(torch.inf)
        self.maximum.fill_(-torch.inf)

    @torch.no_grad()
    def observe(self, x: Tensor) -> None:
        """Widen the range, or let it follow, by x. Blocks without rows stay."""
        low, high = self._range_of(x)
        seen, first = torch.isfinite(low) | torch.isfinite(high), torch.isinf(self.minimum)
        if self.ema is None:
            low, high = torch.minimum(self.minimum, low), torch.maximum(self.maximum, high)
        else:
            low = torch.where(first, low, self.ema * self.minimum + (1 - self.ema) * low)
            high = torch.where(first, high, self.ema * self.maximum + (1 - self.ema) * high)
        self.minimum.copy_(torch.where(seen, low, self.minimum))
        self.maximum.copy_(torch.where(seen, high, self.maximum))

    def forward(self, x: Tensor) -> Tensor:
        """x^ of the shape of x; differentiable."""
        if self.training and self.observing:
            self.observe(x)
        rows = _rows(x)
        scale, zero = (_of_rows(each, len(rows)) for each in self._lattice(x))
        index, inside = _quantized(rows, scale, zero, self.bits)
        return straight_through(rows, scale * (index - zero), inside).reshape(x.shape)

    def encode(self, x: Tensor) -> tuple[Tensor, dict[str, Any]]:
        """q int64 of the shape of x, and {"scale"} float32 [B, C], {"zero"} int32 [B, C], {"bits"} uint8 [].

        Raises ValueError for values or a range that are not finite.
        """
        if x.numel() and not bool(torch.isfinite(x).all()):
            raise ValueError("values to quantize must be finite")
        scale, zero = self._lattice(x)
        if not bool(torch.isfinite(scale).all()):
            raise ValueError("the range to quantize is not finite")
        rows = _rows(x)
        index, _ = _quantized(rows, _of_rows(scale, len(rows)), _of_rows(zero, len(rows)), self.bits)
        side = {"scale": scale.cpu().numpy(), "zero": zero.cpu().numpy().astype(np.int32), "bits": np.uint8(self.bits)}
        return index.to(torch.int64).reshape(x.shape), side

    @staticmethod
    def decode(symbols: Tensor, side: dict[str, Any]) -> Tensor:
        """x^ float32 of the shape of `symbols`. Raises BitstreamError if the side information does not fit."""
        bits = int(integers(side, "bits", (), 1, MAX_BITS))
        shape = np.asarray(side.get("scale")).shape
        if len(shape) != 2 or shape[0] < 1 or (shape[1] != 1 and (symbols.ndim != 2 or shape[1] != symbols.shape[1])):
            raise BitstreamError(f"quantizer scales {list(shape)} do not fit {list(symbols.shape)}")
        scale = floats(side, "scale", shape, positive=True, dtype=np.float32)
        zero = integers(side, "zero", shape, -ZERO_LIMIT, ZERO_LIMIT)
        rows = _rows(within(symbols, 0, 2**bits - 1))
        steps, zeros = (_of_rows(torch.as_tensor(array, device=symbols.device), len(rows)) for array in (scale, zero))
        return finite_values(steps * (rows - zeros).to(torch.float32)).reshape(symbols.shape)

    def _range_of(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Minimum and maximum of each block and channel, [B, C] float32; inf and -inf where there is no row."""
        if self.channels is not None and (x.ndim != 2 or x.shape[1] != self.channels):
            raise ShapeError(f"values have shape {list(x.shape)}")
        if self.minimum.device != x.device:
            self.to(x.device)
        rows = _rows(x.detach()).to(self.minimum.dtype)
        if rows.numel() == 0:
            return torch.full_like(self.minimum, torch.inf), torch.full_like(self.maximum, -torch.inf)
        lows, highs = (rows, rows) if self.channels is not None else torch.aminmax(rows, dim=1, keepdim=True)
        if self.blocks == 1:
            return lows.amin(0, keepdim=True), highs.amax(0, keepdim=True)
        block = block_of_rows(len(rows), self.blocks, x.device)[:, None].expand_as(lows)
        low = torch.full_like(self.minimum, torch.inf).scatter_reduce_(0, block, lows, "amin")
        return low, torch.full_like(self.maximum, -torch.inf).scatter_reduce_(0, block, highs, "amax")

    @torch.no_grad()
    def _lattice(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Scale and zero point, [B, C] float32."""
        low, high = self._range_of(x)
        unseen = torch.isinf(self.minimum) & torch.isinf(self.maximum)
        low, high = torch.where(unseen, low, self.minimum), torch.where(unseen, high, self.maximum)
        if self.zero:
            low, high = low.clamp(max=0), high.clamp(min=0)
        empty = low > high  # no row, and nothing seen
        low, high = torch.where(empty, 0.0, low), torch.where(empty, 0.0, high)
        scale = ((high - low) / (2**self.bits - 1)).clamp_min(SMALLEST_STEP)
        scale = torch.maximum(scale, torch.maximum(low.abs(), high.abs()) / ZERO_LIMIT)
        return scale, torch.round(-low / scale)


def _quantized(rows: Tensor, scale: Tensor, zero: Tensor, bits: int) -> tuple[Tensor, Tensor]:
    """(q, where the clamp did not act), both of the shape of `rows`."""
    rows = rows.detach() if rows.dtype == torch.float64 else rows.detach().to(torch.float32)
    free = torch.round(rows / scale) + zero
    index = free.clamp(0, 2**bits - 1)
    return index, index == free


def _rows(x: Tensor) -> Tensor:
    """x as a matrix: [N] as [N, 1], everything from the second axis on as columns."""
    return x.flatten(1) if x.ndim > 1 else x.reshape(-1, 1)


def _of_rows(values: Tensor, count: int) -> Tensor:
    """values [B, C] of each block for each row, [count, C] or, with one block, [1, C]."""
    return values if len(values) == 1 else values[block_of_rows(count, len(values), values.device)]


def block_of_rows(count: int, blocks: int, device: torch.device) -> Tensor:
    """The block of each of `count` rows, [count] int64: contiguous, sizes differ by at most one, larger ones first."""
    size, larger = divmod(count, blocks)
    row = torch.arange(count, device=device)
    border = larger * (size + 1)
    return torch.where(row < border, row // (size + 1), larger + (row - border) // max(size, 1))
