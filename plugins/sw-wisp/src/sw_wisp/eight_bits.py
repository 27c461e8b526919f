"""Networks in eight bits: weights q 2^e with |q| <= 127 and an exponent a row, biases in sixteen bits.

Exact in float32, and as the integers of `integer-mlp` where e >= -12.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from splatwizard_core.api import BitstreamError
from sw_codecs.bits.packing import ByteReader, write_varint
from sw_codecs.entropy.columns import Columns

LARGEST_WEIGHT, LARGEST_BIAS = 127, 32767
LOWEST_EXPONENT, HIGHEST_EXPONENT = -24, 5
EXACT_EXPONENT = -12
"""Lowest exponent of weights that `integer-mlp` takes as they are."""


@dataclass(frozen=True)
class EightBitLayer:
    """weights [out,in] int8, exponents [out] int8 of its rows, bias [out] int16 (width 0: none), and its exponent."""

    weights: np.ndarray
    exponents: np.ndarray
    bias: np.ndarray
    bias_exponent: int

    @classmethod
    def nearest(cls, weight: np.ndarray, bias: np.ndarray | None, *, lowest: int = LOWEST_EXPONENT) -> EightBitLayer:
        """The layer nearest to float weights [out,in] and biases [out]; no exponent of a row is below `lowest`.

        A row takes the exponent of least squared error with its weights clipped to 127: one large weight must not
        cost the rest of its row. Raises ValueError for numbers that are not finite.
        """
        weight = np.asarray(weight, np.float64)
        bias = np.zeros(0) if bias is None else np.asarray(bias, np.float64)
        if not (np.isfinite(weight).all() and np.isfinite(bias).all()):
            raise ValueError("a network holds numbers that are not finite")
        exponents = row_exponents(weight, lowest)
        q = np.clip(np.rint(np.ldexp(weight, -exponents[:, None])), -LARGEST_WEIGHT, LARGEST_WEIGHT)
        largest = np.abs(bias).max(initial=0)
        own = int(np.ceil(np.log2(max(largest, 1e-12) / LARGEST_BIAS)))
        own = min(max(own, LOWEST_EXPONENT), HIGHEST_EXPONENT)
        b = np.clip(np.rint(np.ldexp(bias, -own)), -LARGEST_BIAS, LARGEST_BIAS)
        return cls(q.astype(np.int8), exponents.astype(np.int8), b.astype(np.int16), own)

    def floats(self) -> tuple[np.ndarray, np.ndarray]:
        """Weights [out,in] and biases [out] as float32, exact; biases 0 where there are none."""
        weight = np.ldexp(self.weights.astype(np.float32), self.exponents[:, None].astype(np.int32))
        bias = np.ldexp(self.bias.astype(np.float32), self.bias_exponent)
        return weight, bias if len(bias) else np.zeros(len(weight), np.float32)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Outputs, inputs, and 1 with biases, 0 without."""
        return self.weights.shape[0], self.weights.shape[1], int(len(self.bias) > 0)


def row_exponents(weight: np.ndarray, lowest: int) -> np.ndarray:
    """Exponents int64 [out] that represent each row of `weight` [out,in] best."""
    choices = np.arange(lowest, HIGHEST_EXPONENT + 1)[:, None, None]
    q = np.clip(np.rint(np.ldexp(weight, -choices)), -LARGEST_WEIGHT, LARGEST_WEIGHT)  # [E, out, in]
    error = ((np.ldexp(q, choices) - weight) ** 2).sum(2)
    best: np.ndarray = lowest + error.argmin(0)
    return best


def rounded_weights(weight: Tensor, lowest: int = LOWEST_EXPONENT) -> Tensor:
    """Weights [out,in] as `EightBitLayer.nearest` would have them, in float, with a straight-through gradient."""
    with torch.no_grad():
        exact = weight.double()
        units = 2.0 ** torch.arange(lowest, HIGHEST_EXPONENT + 1, device=weight.device).double()[:, None, None]
        tried = (exact / units).round().clamp(-LARGEST_WEIGHT, LARGEST_WEIGHT) * units  # [E,out,in]
        best = (tried - exact).square().sum(2).argmin(0)  # [out]
        rounded = tried.gather(0, best[None, :, None].expand(1, -1, weight.shape[1]))[0].to(weight)
    return weight + (rounded - weight.detach())


def pack_layers(layers: Sequence[EightBitLayer]) -> bytes:
    """Bytes of layers whose shapes stand elsewhere."""
    parts = []
    for layer in layers:
        weights = Columns().encode(layer.weights.reshape(-1).astype(np.int64))
        parts += [write_varint(len(weights)), weights, layer.exponents.tobytes()]
        parts += [layer.bias_exponent.to_bytes(1, "little", signed=True), layer.bias.astype("<i2").tobytes()]
    return b"".join(parts)


def unpack_layers(reader: ByteReader, shapes: Sequence[tuple[int, int, int]]) -> tuple[EightBitLayer, ...]:
    """Inverse of `pack_layers`. Raises BitstreamError."""
    found = []
    for rows, columns, has_bias in shapes:
        if rows * columns > 8 * reader.left + 4096:
            raise BitstreamError(f"a network of {rows:,} x {columns:,} weights is not there")
        weights = Columns().decode(bytes(reader.take(reader.varint(reader.left))), (rows * columns,))
        exponents = np.frombuffer(reader.take(rows), np.int8)
        own = reader.integer(1, signed=True)
        bias = np.frombuffer(reader.take(2 * rows * has_bias), "<i2").astype(np.int16)
        in_range = min(own, int(exponents.min(initial=0))) >= LOWEST_EXPONENT
        if not in_range or max(own, int(exponents.max(initial=0))) > HIGHEST_EXPONENT:
            raise BitstreamError("an exponent of a network is out of range")
        if np.abs(weights).max(initial=0) > LARGEST_WEIGHT or (bias == -LARGEST_BIAS - 1).any():
            raise BitstreamError("a weight of a network is out of range")
        found.append(EightBitLayer(weights.reshape(rows, columns).astype(np.int8), exponents, bias, own))
    return tuple(found)
