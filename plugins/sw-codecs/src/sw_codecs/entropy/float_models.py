"""Entropy models `gaussian` and `laplace`: mean and scale per symbol in floating point, to the last 0.1 % of the rate.

The decoder needs the very floats of the encoder, and evaluates the density as the encoder's machine did. That suits
parameters that stand in the file themselves, comparison with published sizes, and measuring what `gaussian-exact` and
`laplace-exact` give away. These two are the default for files: integers from a context network, any machine. A decoder
whose floats or whose library differ notices it by the CRC-32 and says so; it cannot repair it.

Layout: u8 version, u32 CRC-32 of the parameters, varint radius R, varint number of escapes, varint length and chunks of
the `range` coder, escapes as Exp-Golomb bits. Coded is s = symbol - round(mean / step), with -R and R for all beyond.
Source: specification of the codec library, coder mode float.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from torch import Tensor

from splatwizard_core.api import BitstreamError
from sw_codecs.bits import checksum, exp_golomb
from sw_codecs.bits.packing import ByteReader, bit_length, write_varint
from sw_codecs.coders.arithmetic import RangeCoder
from sw_codecs.coders.model_spec import Gaussian, Laplace, ModelSpec, as_symbols
from sw_codecs.entropy.gaussian_exact import SYMBOL_LIMIT, FloatContext
from sw_codecs.entropy.rates import gaussian_bits, laplace_bits

VERSION = 1
MAX_RADIUS_BITS = 20
PROBABILITIES = 1 << 24  # of the coder; each of the 2 R + 1 symbols gets at least one


class FloatModel:
    """Codes integer symbols [n], |k| < 2^30, whose values are k * step; see the two subclasses.

    `model.Context(mean, scale, step)`: floats in the unit of the values, tensors or arrays. `encode` and
    `decode` take a mean [n], scale and step as numbers or [n].
    """

    Context = FloatContext
    spec: ClassVar[type[Gaussian] | type[Laplace]]

    def bits(self, symbols: Tensor, context: FloatContext) -> Tensor:
        """Bits of each value (its unit is the context's; rounded or with noise added); differentiable."""
        raise NotImplementedError

    def encode(self, symbols: np.ndarray, context: FloatContext) -> bytes:
        """Bytes of `symbols`. Raises ValueError for symbols or parameters out of range."""
        symbols = as_symbols(symbols)
        if symbols.size and (symbols.min() <= -SYMBOL_LIMIT or symbols.max() >= SYMBOL_LIMIT):
            raise ValueError("a symbol is beyond 2^30")
        centre, rest, scale, crc = _parameters(context, len(symbols))
        offsets = symbols.astype(np.int64) - centre
        radius = _radius(np.abs(offsets))
        beyond = np.abs(offsets) >= radius
        chunks = RangeCoder().encode(np.clip(offsets, -radius, radius), self._model(rest, scale, radius))
        escaped = offsets[beyond]
        return b"".join(
            [
                bytes([VERSION]) + crc.to_bytes(4, "little") + write_varint(radius),
                write_varint(len(chunks)) + chunks,
                exp_golomb.encode(escaped < 0, np.abs(escaped) - radius),
            ]
        )

    def decode(self, data: bytes, context: FloatContext) -> np.ndarray:
        """int32 [n], n as in the context's mean. Raises BitstreamError."""
        reader = ByteReader(data)
        try:
            n = _array(context.mean).size
            centre, rest, scale, crc = _parameters(context, n)
        except ValueError as error:
            raise BitstreamError(str(error)) from error
        if reader.integer(1) != VERSION:
            raise BitstreamError("float-coded data of this version is not known: upgrade sw-codecs")
        if reader.integer(4) != crc:
            raise BitstreamError("the means and scales are not those that the symbols were coded with")
        radius = reader.varint(1 << MAX_RADIUS_BITS)
        if radius < 1:
            raise BitstreamError("float-coded data has no symbols")
        chunks = bytes(reader.take(reader.varint(reader.left)))
        offsets = RangeCoder().decode(chunks, n, self._model(rest, scale, radius)).astype(np.int64)
        where = np.flatnonzero(np.abs(offsets) == radius)
        negative, magnitude = exp_golomb.decode(reader.take(reader.left), len(where))
        if (negative != (offsets[where] < 0)).any():
            raise BitstreamError("an escape has the wrong sign")
        offsets[where] += np.where(negative, -magnitude, magnitude)
        symbols = offsets + centre
        if symbols.size and (symbols.min() <= -SYMBOL_LIMIT or symbols.max() >= SYMBOL_LIMIT):
            raise BitstreamError("a symbol is beyond 2^30")
        return symbols.astype(np.int32)

    def _model(self, rest: np.ndarray, scale: np.ndarray, radius: int) -> ModelSpec:
        return self.spec(rest, scale, -radius, radius)


class GaussianFloat(FloatModel):
    """Gaussian with mean and standard deviation per symbol."""

    spec = Gaussian

    def bits(self, symbols: Tensor, context: FloatContext) -> Tensor:
        return gaussian_bits(symbols, context.mean, context.scale, context.step, **context.bound)


class LaplaceFloat(FloatModel):
    """Laplacian with mean and scale b (density exp(-|x - mean| / b) / 2b) per symbol."""

    spec = Laplace

    def bits(self, symbols: Tensor, context: FloatContext) -> Tensor:
        return laplace_bits(symbols, context.mean, context.scale, context.step, **context.bound)


def _array(value: Any) -> np.ndarray:
    return np.asarray(value.detach().cpu() if isinstance(value, Tensor) else value, np.float64)


def _parameters(context: FloatContext, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Nearest integer to each mean in steps int64 [n], what is left of it [n], scale in steps [n], CRC-32 of both."""
    mean, scale, step = (_array(each) for each in (context.mean, context.scale, context.step))
    for name, array in (("mean", mean), ("scale", scale), ("step", step)):
        if array.shape != (n,) and (name == "mean" or array.shape != ()):
            raise ValueError(f"{name} must be {n} numbers, not of shape {list(array.shape)}")
    if not ((step > 0).all() and np.isfinite(step).all()):
        raise ValueError("step holds values that are not positive")
    mean, scale = (np.ascontiguousarray(np.broadcast_to(each / step, n)) for each in (mean, scale))
    if not (np.abs(mean) < SYMBOL_LIMIT).all():
        raise ValueError("a mean is not finite, or beyond 2^30 steps")
    crc = checksum.crc32(scale.astype("<f8", copy=False), checksum.crc32(mean.astype("<f8", copy=False)))
    centre = np.rint(mean)
    return centre.astype(np.int64), mean - centre, scale, crc


def _radius(distances: np.ndarray) -> int:
    """R that costs least: a wide domain leaks probability, a narrow one sends symbols into escapes.

    A domain up to the largest distance, or one of 2^j with all symbols of that distance or more escaped.
    """
    if not len(distances):
        return 1
    length = np.bincount(bit_length(distances), minlength=MAX_RADIUS_BITS + 1)  # distances 2^(j-1) .. 2^j - 1
    found = {1 << j: 24.0 * length[j + 1 :].sum() + 2.0 * (length * np.arange(len(length)))[j + 1 :].sum()
             for j in range(MAX_RADIUS_BITS + 1)}  # fmt: skip
    largest = int(distances.max()) + 1
    if largest < 1 << MAX_RADIUS_BITS:
        found[largest] = 0.0
    leak = {radius: -len(distances) * np.log2(1 - (2 * radius + 1) / PROBABILITIES) for radius in found}
    return min(found, key=lambda radius: found[radius] + leak[radius])
