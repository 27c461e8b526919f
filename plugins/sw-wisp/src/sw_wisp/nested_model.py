"""Entropy model `nested-gaussian` by itself: integers under centred Gaussians, in the stream that packets of wisp have.

Layout: u32 CRC-32 of the symbols as i32, then the words of `sw_wisp.nested`.
"""

from __future__ import annotations

import numpy as np
from torch import Tensor

from splatwizard_core.api import BitstreamError
from sw_codecs.bits import checksum
from sw_codecs.bits.packing import ByteReader
from sw_wisp import rate
from sw_wisp.fast.streams import reader_of
from sw_wisp.nested import Writer, table_levels


class NestedGaussian:
    """Codes indices [...], |k| < 2^21, that count steps from their means.

    context     scale levels [...]: int64 with 12 fractional bits, 0 to 63 times 4096; for `bits` floats, 0 to 63
    """

    def bits(self, symbols: Tensor, context: Tensor) -> Tensor:
        """Bits of each index, rounded or with noise; differentiable in both."""
        return rate.bits(symbols, rate.sigma_of(context, 1.0), 1.0)

    def encode(self, symbols: np.ndarray, context: np.ndarray) -> bytes:
        """Bytes of indices. Raises ValueError if one is out of range."""
        wanted, stream = np.asarray(symbols).astype(np.int64, casting="safe"), Writer()
        stream.indices(table_levels(np.asarray(context)), wanted)
        return _crc(wanted).to_bytes(4, "little") + stream.finish()

    def decode(self, data: bytes, context: np.ndarray) -> np.ndarray:
        """Indices int64 in the shape of the context. Raises BitstreamError."""
        reader = ByteReader(data)
        crc = reader.integer(4)
        stream = reader_of(reader.take(reader.left))
        found = stream.indices(table_levels(np.asarray(context)), None)
        stream.finish()
        if _crc(found) != crc:
            raise BitstreamError("the decoded indices do not match their CRC-32: damaged data or a wrong context")
        return found


def _crc(symbols: np.ndarray) -> int:
    return checksum.crc32(symbols.astype("<i4").tobytes())
