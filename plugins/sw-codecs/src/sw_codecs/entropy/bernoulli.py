"""Entropy model `bernoulli`: masks of 0 and 1 under their stored share of ones."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from splatwizard_core.api import BitstreamError
from sw_codecs.bits.packing import ByteReader, write_varint
from sw_codecs.coders.arithmetic import RangeCoder
from sw_codecs.coders.model_spec import Bernoulli as BernoulliSpec
from sw_codecs.entropy.further_rates import bernoulli_bits


class Bernoulli:
    """`context` is the number of symbols for `decode`; `bits` and `encode` do not use it."""

    def bits(self, symbols: Tensor, context: int | None = None) -> Tensor:
        """Bits per symbol of {0, 1} (bool, integer or straight-through floats) with their own share of ones.

        Differentiable through the symbols; shape of `symbols`.
        """
        values = symbols if symbols.is_floating_point() else symbols.to(torch.get_default_dtype())
        return bernoulli_bits(values, values.mean() if values.numel() else 0.5)

    def encode(self, symbols: np.ndarray, context: int | None = None) -> bytes:
        """varint number of ones, then chunks of the `range` coder. Raises ValueError for other symbols than 0 and 1."""
        symbols = np.asarray(symbols)
        if symbols.dtype == bool:
            symbols = symbols.astype(np.int32)
        ones = int(symbols.sum()) if symbols.size else 0
        return write_varint(max(ones, 0)) + RangeCoder().encode(symbols, BernoulliSpec(_share(ones, len(symbols))))

    def decode(self, data: bytes, context: int) -> np.ndarray:
        """int32 [context] of 0 and 1. Raises BitstreamError."""
        reader = ByteReader(data)
        ones = reader.varint(context)
        symbols = RangeCoder().decode(bytes(reader.take(reader.left)), context, BernoulliSpec(_share(ones, context)))
        if int(symbols.sum()) != ones:
            raise BitstreamError(f"a mask with {int(symbols.sum()):,} ones, {ones:,} were announced")
        return symbols


def _share(ones: int, n: int) -> float:
    return min(max(ones / n, 0.0), 1.0) if n else 0.5
