"""Integers as bits: fixed-width packing, variable-length integers, and a split into a class and raw low bits."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from splatwizard_core.api import BitstreamError

MAX_VARINT_BYTES = 10


def zigzag(values: npt.ArrayLike) -> np.ndarray:
    """Signed to unsigned 64-bit: 0, -1, 1, -2, ... become 0, 1, 2, 3, ..."""
    signed = np.asarray(values, np.int64)
    return ((signed << 1) ^ (signed >> 63)).view(np.uint64)


def unzigzag(values: np.ndarray) -> np.ndarray:
    """Inverse of `zigzag`; int64."""
    unsigned = np.asarray(values, np.uint64)
    half = (unsigned >> np.uint64(1)).view(np.int64)
    return half ^ -(unsigned & np.uint64(1)).view(np.int64)


def bit_length(values: np.ndarray) -> np.ndarray:
    """Bits needed to write each unsigned integer, 0 for 0; int64. Exact over all 64 bits."""
    unsigned = np.asarray(values, np.uint64)
    if unsigned.max(initial=0) < 1 << 53:
        return np.frexp(unsigned.astype(np.float64))[1].astype(np.int64)
    high, low = unsigned >> np.uint64(32), unsigned & np.uint64(0xFFFFFFFF)
    # frexp is exact on the 32-bit halves; on the whole it would round 2^53-1 and up.
    return np.where(high > 0, np.frexp(high.astype(np.float64))[1] + 32, np.frexp(low.astype(np.float64))[1]).astype(
        np.int64
    )


def split_classes(values: np.ndarray, mantissa: int) -> tuple[np.ndarray, np.ndarray]:
    """Unsigned integers as a class (leading bits and magnitude) and the number of raw low bits left over.

    mantissa    bits after the leading one that the class keeps; integers below 2^(mantissa+1) are their own class

    Returns (class int64, raw bits int64); class numbers rise with the value and have no gaps.
    """
    unsigned = np.asarray(values, np.uint64)
    extra = np.maximum(bit_length(unsigned) - 1 - mantissa, 0)
    return (extra << mantissa) + (unsigned >> extra.astype(np.uint64)).astype(np.int64), extra


def class_bits(classes: np.ndarray, mantissa: int) -> np.ndarray:
    """Number of raw low bits of values of these classes, int64."""
    return np.maximum((np.asarray(classes, np.int64) >> mantissa) - 1, 0)


def class_floor(classes: np.ndarray, mantissa: int) -> np.ndarray:
    """The smallest value of each class; uint64."""
    classes = np.asarray(classes, np.int64)
    extra = class_bits(classes, mantissa)
    return (classes - (extra << mantissa)).astype(np.uint64) << extra.astype(np.uint64)


def pack_fixed(values: np.ndarray, width: int) -> bytes:
    """The low `width` bits (0..64) of every unsigned integer, least significant first, zero-padded to a byte."""
    if width == 0 or len(values) == 0:
        return b""
    octets = np.asarray(values, "<u8").view(np.uint8).reshape(-1, 8)[:, : (width + 7) // 8]
    bits = np.unpackbits(octets, axis=1, bitorder="little")[:, :width]
    return np.packbits(bits.ravel(), bitorder="little").tobytes()


def packed_size(count: int, width: int) -> int:
    """Bytes that `pack_fixed` writes for `count` integers."""
    return (count * width + 7) // 8


def unpack_fixed(data: bytes | memoryview, count: int, width: int) -> np.ndarray:
    """Inverse of `pack_fixed`: [count] uint64. Raises BitstreamError if `data` has not exactly the right length."""
    if len(data) != packed_size(count, width):
        raise BitstreamError(f"{len(data):,} bytes of raw bits, expected {packed_size(count, width):,}")
    if width == 0 or count == 0:
        return np.zeros(count, np.uint64)
    bits = np.unpackbits(np.frombuffer(data, np.uint8), bitorder="little")
    if bits[count * width :].any():
        raise BitstreamError("the padding of raw bits is not zero")
    octets = np.zeros((count, 8), np.uint8)
    octets[:, : (width + 7) // 8] = np.packbits(bits[: count * width].reshape(count, width), axis=1, bitorder="little")
    return octets.view("<u8").ravel().astype(np.uint64)


def write_varint(value: int) -> bytes:
    """A non-negative integer, 7 bits per byte, least significant first, top bit set on all but the last."""
    if not 0 <= value < 1 << 64:
        raise ValueError(f"{value} is not an unsigned 64-bit integer")
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def write_signed(value: int) -> bytes:
    """A signed integer as the varint of its zigzag code."""
    return write_varint(int(zigzag([value])[0]))


class ByteReader:
    """Takes fields off the front of a byte string; running out of bytes is a BitstreamError."""

    def __init__(self, data: bytes | memoryview) -> None:
        self._data = memoryview(data)
        self._position = 0

    @property
    def left(self) -> int:
        """Bytes not taken yet."""
        return len(self._data) - self._position

    def take(self, count: int) -> memoryview:
        """The next `count` bytes, not copied."""
        if not 0 <= count <= self.left:
            raise BitstreamError(f"{count:,} bytes are needed, {self.left:,} are left: the data is truncated")
        self._position += count
        return self._data[self._position - count : self._position]

    def integer(self, size: int, *, signed: bool = False) -> int:
        """A little-endian integer of `size` bytes."""
        return int.from_bytes(self.take(size), "little", signed=signed)

    def varint(self, limit: int) -> int:
        """A varint of at most `limit`."""
        value = 0
        for i in range(MAX_VARINT_BYTES):
            byte = self.take(1)[0]
            value |= (byte & 0x7F) << (7 * i)
            if byte < 0x80:
                if value > limit or (byte == 0 and i > 0):
                    raise BitstreamError(f"an integer is {value:,}, at most {limit:,} is allowed")
                return value
        raise BitstreamError("an integer has too many bytes")

    def signed(self) -> int:
        """A signed 64-bit varint."""
        return int(unzigzag(np.array([self.varint((1 << 64) - 1)], np.uint64))[0])

    def finish(self) -> None:
        """Raise BitstreamError if bytes are left."""
        if self.left:
            raise BitstreamError(f"{self.left:,} unknown bytes at the end")
