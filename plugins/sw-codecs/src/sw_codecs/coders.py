"""The entropy coders `range` and `rans`: symbols under a ModelSpec to bytes and back, in checked chunks.

Each chunk of at most 2^20 symbols starts with 20 bytes: u32 n, i32 kmin, i32 kmax (smallest and largest symbol),
u32 byte length, u32 CRC-32 of the decoded symbols as little-endian int32. Chunks follow one another; no symbols, no
bytes. A chunk with kmin = kmax has no payload. Source: specification of the codec library, entropy coders.
"""

from __future__ import annotations

import dataclasses
import struct
import zlib
from types import ModuleType
from typing import ClassVar

import numpy as np

from splatwizard_core.errors import BitstreamError
from sw_codecs import model_spec
from sw_codecs.bits import ByteReader
from sw_codecs.model_spec import Gaussian, Laplace, ModelSpec, as_symbols, check_length, domain
from sw_codecs.symbol_stream import SymbolReader, SymbolWriter

CHUNK = 1 << 20
HEADER = struct.Struct("<IiiII")


class ChunkedCoder:
    """Framing that all entropy coders share; a subclass codes the payload of one chunk.

    specs   the probability models that `encode` and `decode` take (`specs.Table(counts)`, ...), for packages that
            asked the registry for a coder and import nothing of this one
    """

    specs: ClassVar[ModuleType] = model_spec

    def encode(self, symbols: np.ndarray, model: ModelSpec) -> bytes:
        """Bytes of `symbols` [n]: integers within the model's domain.

        Raises ValueError for symbols outside the domain or parameters of another length.
        """
        symbols = as_symbols(symbols)
        check_length(model, len(symbols))
        low, high = domain(model)
        if len(symbols) and (symbols.min() < low or symbols.max() > high):
            raise ValueError(f"symbols {symbols.min()}..{symbols.max()} leave the model's domain {low}..{high}")
        parts = []
        for start in range(0, len(symbols), CHUNK):
            chunk = np.ascontiguousarray(symbols[start : start + CHUNK], "<i4")
            kmin, kmax = int(chunk.min()), int(chunk.max())
            spec = _tightened(model.part(start, start + len(chunk)), kmin, kmax)
            payload = b"" if kmin == kmax else self._encode_chunk(chunk, spec)
            # A model in floating point is tied to the machine: here at least it must decode.
            if (
                payload
                and isinstance(spec, (Gaussian, Laplace))
                and not np.array_equal(self._decode_chunk(memoryview(payload), len(chunk), spec), chunk)
            ):
                raise RuntimeError("a chunk does not decode to what was encoded; please report this")
            parts += [HEADER.pack(len(chunk), kmin, kmax, len(payload), zlib.crc32(chunk)), payload]
        return b"".join(parts)

    def decode(self, data: bytes, n: int, model: ModelSpec) -> np.ndarray:
        """[n] int32. Raises BitstreamError unless `data` is what `encode` wrote for n symbols and this model."""
        check_length(model, n)
        low, high = domain(model)
        reader = ByteReader(data)
        found = np.empty(n, np.int32)
        start = 0
        while start < n:
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
                chunk = self._decode_chunk(payload, count, _tightened(model.part(start, start + count), kmin, kmax))
            if zlib.crc32(np.ascontiguousarray(chunk, "<i4")) != crc or chunk.min() != kmin or chunk.max() != kmax:
                raise BitstreamError("the decoded symbols do not match their CRC-32: damaged data or a wrong model")
            found[start : start + count] = chunk
            start += count
        reader.finish()
        return found

    def _encode_chunk(self, symbols: np.ndarray, spec: ModelSpec) -> bytes:
        raise NotImplementedError

    def _decode_chunk(self, payload: memoryview, count: int, spec: ModelSpec) -> np.ndarray:
        raise NotImplementedError


def _tightened(spec: ModelSpec, kmin: int, kmax: int) -> ModelSpec:
    """A wide domain leaks probability (2^-24 a symbol), so parametric models cover just what the chunk holds."""
    if isinstance(spec, (Gaussian, Laplace)) and kmin < kmax:
        return dataclasses.replace(spec, kmin=kmin, kmax=kmax)
    return spec


class RangeCoder(ChunkedCoder):
    """Arithmetic (range) coding; decodes in the order of encoding."""

    _last_in_first_out: ClassVar[bool] = False

    def _encode_chunk(self, symbols: np.ndarray, spec: ModelSpec) -> bytes:
        writer = SymbolWriter(last_in_first_out=self._last_in_first_out)
        writer.put(symbols, spec)
        return writer.finish()

    def _decode_chunk(self, payload: memoryview, count: int, spec: ModelSpec) -> np.ndarray:
        return SymbolReader(payload, last_in_first_out=self._last_in_first_out).get(count, spec)


class RansCoder(RangeCoder):
    """rANS: as compact as range coding, a little faster to encode."""

    _last_in_first_out = True
