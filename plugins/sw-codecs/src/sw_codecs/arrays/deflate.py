"""Coder `deflate`: numbers as they are, without loss, one DEFLATE stream an array: the packing of published files.

Layout (docs/bitstream.md): u8 version, then a zlib stream (RFC 1950) of the values, little-endian, row after row.
`byte-planes` is shorter for most arrays; this one gives the sizes that methods report which zip their arrays, such as
C3DGS (arXiv 2401.02436).
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from splatwizard_core.api import BitstreamError

VERSION = 1
LEVEL = 9
KINDS = "fiu"


class Deflate:
    """Any array of floats or integers [N], [N, C], ...; bit for bit. The array must lie in the CPU's memory."""

    def encode(self, array: npt.ArrayLike) -> bytes:
        """Bytes of `array`. Raises ValueError for dtypes other than floats and integers, and for a single number."""
        values = np.asarray(array)
        if values.dtype.kind not in KINDS or values.ndim == 0:
            raise ValueError(f"deflate is of floats or integers [N, ...], not {values.dtype} {list(values.shape)}")
        plain = values.astype(values.dtype.newbyteorder("<"), copy=False).tobytes()
        return bytes([VERSION]) + zlib.compress(plain, LEVEL)

    def decode(self, data: bytes, dtype: npt.DTypeLike, shape: Sequence[int]) -> np.ndarray:
        """The array, writable. Raises BitstreamError unless `data` is what `encode` wrote for this dtype and shape.

        It takes about twice the memory of the array, however short `data` is: a shape that comes from a file must be
        held against `reader.allow` first.
        """
        wanted = np.dtype(dtype).newbyteorder("<")
        shape = tuple(int(n) for n in shape)
        if wanted.kind not in KINDS or not shape or min(shape) < 0:
            raise ValueError(f"deflate is of floats or integers [N, ...], not {wanted} {list(shape)}")
        if data[:1] != bytes([VERSION]):
            raise BitstreamError(f"a DEFLATE array of version {data[0] if data else 'none'}: upgrade sw-codecs")
        size = math.prod(shape) * wanted.itemsize
        stream = zlib.decompressobj()
        try:
            plain = stream.decompress(data[1:], size + 1)
        except zlib.error as error:
            raise BitstreamError(f"not a zlib stream: {error}") from error
        if not stream.eof or stream.unused_data or len(plain) != size:
            raise BitstreamError(f"the zlib stream does not hold exactly {list(shape)} of {wanted}, {size:,} bytes")
        return np.frombuffer(plain, wanted).reshape(shape).astype(wanted.newbyteorder("="), copy=True)
