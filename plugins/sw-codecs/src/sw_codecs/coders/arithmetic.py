"""The entropy coders `range` and `rans`: symbols under a ModelSpec to bytes and back, in checked chunks.

Each chunk of at most 2^20 symbols starts with 20 bytes: u32 n, i32 kmin, i32 kmax (smallest and largest symbol),
u32 byte length, u32 CRC-32 of the decoded symbols as little-endian int32. Chunks follow one another; no symbols, no
bytes. A chunk with kmin = kmax has no payload. Source: specification of the codec library, entropy coders.
"""

from __future__ import annotations

import struct
from types import ModuleType
from typing import ClassVar

import numpy as np
import torch

from splatwizard_core.api import BitstreamError
from sw_codecs.bits import checksum
from sw_codecs.bits.packing import ByteReader
from sw_codecs.coders import model_spec
from sw_codecs.coders.model_spec import (
    Bernoulli,
    Gaussian,
    Laplace,
    ModelSpec,
    as_symbols,
    changed,
    check_length,
    domain,
)
from sw_codecs.coders.symbol_stream import SymbolReader, SymbolWriter, check_again
from sw_codecs.exact_native import has_exact
from sw_codecs.fast import exact_operations

CHUNK = 1 << 20
HEADER = struct.Struct("<IiiII")


class ChunkedCoder:
    """Framing that all entropy coders share; a subclass codes the payload of one chunk.

    specs   the probability models that `encode` and `decode` take (`specs.Table(counts)`, ...), for packages that
            asked the registry for a coder and import nothing of this one
    verify  decode every chunk under a model in floating point again before it is written: three times as slow, and
            the only proof there is
    """

    specs: ClassVar[ModuleType] = model_spec

    def __init__(self, *, verify: bool = True) -> None:
        self.verify = verify

    def encode(self, symbols: np.ndarray, model: ModelSpec) -> bytes:
        """Bytes of `symbols` [n]: integers within the model's domain.

        Raises ValueError for symbols outside the domain or parameters of another length.
        """
        symbols = as_symbols(symbols)
        check_length(model, len(symbols))
        low, high = domain(model)
        parts = []
        for start in range(0, len(symbols), CHUNK):
            given = symbols[start : start + CHUNK]
            kmin, kmax = int(given.min()), int(given.max())
            if kmin < low or kmax > high:
                raise ValueError(f"symbols {kmin}..{kmax} leave the model's domain {low}..{high}")
            chunk = np.ascontiguousarray(given, "<i4")
            spec = _for_chunk(model, start, len(chunk), kmin, kmax)
            payload = b"" if kmin == kmax else self._encode_chunk(chunk, spec)
            # A model in floating point is tied to the machine: here at least it must decode.
            if self.verify and payload and isinstance(spec, (Gaussian, Laplace)):
                check_again(self._decode_chunk(memoryview(payload), len(chunk), spec), chunk)
            parts += [HEADER.pack(len(chunk), kmin, kmax, len(payload), checksum.crc32(chunk)), payload]
        return b"".join(parts)

    def decode(self, data: bytes, n: int, model: ModelSpec) -> np.ndarray:
        """[n] int32. Raises BitstreamError unless `data` is what `encode` wrote for n symbols and this model."""
        check_length(model, n)
        low, high = domain(model)
        reader = ByteReader(data)
        if reader.left < HEADER.size * -(-n // CHUNK):
            raise BitstreamError(f"{reader.left:,} bytes cannot hold {n:,} symbols: truncated data or a wrong number")
        # One array from the start: each chunk is freed as soon as it is copied, and the next takes its memory.
        found = np.empty(n, np.int32)
        for start in range(0, n, CHUNK):
            count, kmin, kmax, length, crc = HEADER.unpack(reader.take(HEADER.size))
            if count != min(CHUNK, n - start):
                raise BitstreamError(f"a chunk has {count:,} symbols, expected {min(CHUNK, n - start):,}")
            if not low <= kmin <= kmax <= high:
                raise BitstreamError(f"a chunk has symbols {kmin}..{kmax}, the model's domain is {low}..{high}")
            payload = reader.take(length)
            if kmin == kmax:
                if length:
                    raise BitstreamError("a chunk of one repeated symbol has a payload")
                chunk = np.full(count, kmin, np.int32)
            else:
                chunk = self._decode_chunk(payload, count, _for_chunk(model, start, count, kmin, kmax))
            if checksum.crc32(np.ascontiguousarray(chunk, "<i4")) != crc or chunk.min() != kmin or chunk.max() != kmax:
                raise BitstreamError("the decoded symbols do not match their CRC-32: damaged data or a wrong model")
            found[start : start + count] = chunk
        reader.finish()
        return found

    def _encode_chunk(self, symbols: np.ndarray, spec: ModelSpec) -> bytes:
        raise NotImplementedError

    def _decode_chunk(self, payload: memoryview, count: int, spec: ModelSpec) -> np.ndarray:
        raise NotImplementedError


def _for_chunk(model: ModelSpec, start: int, count: int, kmin: int, kmax: int) -> ModelSpec:
    """The model of a chunk's symbols. A wide domain leaks probability (2^-24 a symbol), so parametric models cover just
    what the chunk holds.
    """
    spec = model.part(start, start + count)
    return changed(spec, kmin=kmin, kmax=kmax) if isinstance(spec, (Gaussian, Laplace)) and kmin < kmax else spec


class RangeCoder(ChunkedCoder):
    """Arithmetic (range) coding; decodes in the order of encoding."""

    _last_in_first_out: ClassVar[bool] = False

    def _encode_chunk(self, symbols: np.ndarray, spec: ModelSpec) -> bytes:
        writer = SymbolWriter(last_in_first_out=self._last_in_first_out)
        writer.put_checked(symbols, spec)
        return writer.finish()

    def _decode_chunk(self, payload: memoryview, count: int, spec: ModelSpec) -> np.ndarray:
        is_plain = isinstance(spec, Bernoulli) and np.ndim(spec.p) == 0 and len(payload) % 4 == 0
        if is_plain and not self._last_in_first_out and has_exact():
            return _decode_bits(payload, count, float(spec.p))
        return SymbolReader(payload, last_in_first_out=self._last_in_first_out).get_unchecked(count, spec)


def _decode_bits(payload: memoryview, count: int, share: float) -> np.ndarray:
    words = torch.from_numpy(np.frombuffer(payload, np.uint8).copy())
    zeros = int((1 - share) * ((1 << 24) - 2)) + 1  # docs/bitstream.md, tables of counts as models
    bits, status = exact_operations.decode_bits(words, zeros, count)
    if status:
        raise BitstreamError("the coded words are damaged")
    found: np.ndarray = bits.numpy()
    return found


class RansCoder(RangeCoder):
    """rANS: as compact as range coding, a little faster to encode."""

    _last_in_first_out = True
