"""Coder `packed-bits`: indices at a fixed width, most significant bit first, nothing else."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from splatwizard_core.api import BitstreamError

MAX_WIDTH = 16
BLOCK = 1 << 20  # indices at once; a multiple of 8, so that every block starts at a byte


class PackedBits:
    """Integers [n], 0 <= i < size: ceil(n width / 8) bytes and no header, as the papers count indices.

    size    1..2^16; each takes `width` bits, ceil(log2 size) and at least 1

    There is no checksum: a section of a `.swz` file has its own.
    """

    def __init__(self, size: int = 1 << MAX_WIDTH) -> None:
        if not 1 <= size <= 1 << MAX_WIDTH:
            raise ValueError(f"indices into {size:,} entries cannot be packed: 1..{1 << MAX_WIDTH:,} can")
        self.width = max((size - 1).bit_length(), 1)

    def encode(self, array: npt.ArrayLike) -> bytes:
        """Bytes of integers [n]; the last is padded with zeros. Raises ValueError for values beyond `width` bits."""
        width, values = self.width, np.asarray(array)
        if values.ndim != 1 or values.dtype.kind not in "iu":
            raise ValueError(f"indices must be integers [n], not {values.dtype} {list(values.shape)}")
        if values.size and (values.min() < 0 or values.max() >= 1 << width):
            raise ValueError(f"indices {values.min()}..{values.max()} leave 0..{(1 << width) - 1} ({width} bits)")
        parts = []
        for start in range(0, len(values), BLOCK):
            octets = values[start : start + BLOCK].astype(">u2").view(np.uint8).reshape(-1, 2)
            parts.append(np.packbits(np.unpackbits(octets, axis=1)[:, MAX_WIDTH - width :]).tobytes())
        return b"".join(parts)

    def decode(self, data: bytes, dtype: npt.DTypeLike, shape: Sequence[int]) -> np.ndarray:
        """Integers [n] of `dtype`, shape (n,).

        Raises BitstreamError unless `data` has ceil(n width / 8) bytes and its padding is zero, ValueError for a dtype
        that does not hold all values.
        """
        (n,), width, wanted = shape, self.width, np.dtype(dtype)
        if wanted.kind not in "iu" or np.iinfo(wanted).max < (1 << width) - 1:
            raise ValueError(f"{wanted} does not hold indices of {width} bits")
        if len(data) != (n * width + 7) // 8:
            raise BitstreamError(
                f"{len(data):,} bytes of packed bits, {n:,} of {width} bits are {(n * width + 7) // 8:,}"
            )
        octets, found = np.frombuffer(data, np.uint8), np.empty(n, wanted.newbyteorder("="))
        for start in range(0, n, BLOCK):
            count = min(BLOCK, n - start)
            begin = start * width // 8
            bits = np.unpackbits(octets[begin : begin + (count * width + 7) // 8])
            if bits[count * width :].any():
                raise BitstreamError("the padding of packed bits is not zero")
            block = np.zeros((count, MAX_WIDTH), np.uint8)
            block[:, MAX_WIDTH - width :] = bits[: count * width].reshape(count, width)
            found[start : start + count] = np.packbits(block, axis=1).view(">u2").ravel()
        return found
