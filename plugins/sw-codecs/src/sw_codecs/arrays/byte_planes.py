"""Coders `byte-planes` and `float-delta`: numbers as they are, without loss, their bytes regrouped for zstd.

Bytes of equal weight of one column (all sign and exponent bytes, say) resemble each other far more than the bytes of
one number do. Rows keep their order: bring them into a spatial order first (`sort`), and neighbours resemble each other
too. No model, nothing to train: for what must stay exact or is not worth a quantizer.

Layout (docs/bitstream.md): u8 version, u8 form (0: the values as they are; 1: a zstd frame of the byte planes), u32
CRC-32 of the values as they are, then values or frame, whichever is shorter.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from splatwizard_core.api import BitstreamError
from sw_codecs.bits import checksum, zstd_frame
from sw_codecs.bits.packing import ByteReader
from sw_codecs.positions.ordering import spatial_order

VERSION = 1
PLAIN, PLANES = 0, 1
KINDS = "fiu"
OWN_STATISTICS = 4096  # rows from which on a plane gains more from statistics of its own than these cost
SIGN = np.uint32(1 << 31)


class BytePlanes:
    """Any array of floats or integers [N], [N, C], ..., each trailing element a column; bit for bit.

    The array must lie in the CPU's memory: `tensor.cpu().numpy()`. `BytePlanes.sort(points)` gives the indices that
    bring float points [N, 3] into Morton order.
    """

    sort = staticmethod(spatial_order)

    def encode(self, array: npt.ArrayLike) -> bytes:
        """Bytes of `array`: float16, float32, float64 or integers, first axis the rows.

        At most 6 bytes longer than the values. Raises ValueError for other dtypes and for numbers without an axis.
        """
        values = np.asarray(array)
        if values.dtype.kind not in KINDS or values.ndim == 0:
            raise ValueError(f"byte planes are of floats or integers [N, ...], not {values.dtype} {list(values.shape)}")
        plain = values.astype(values.dtype.newbyteorder("<"), copy=False).tobytes()
        frame = zstd_frame.compress(*_planes(plain, len(values), values.dtype.itemsize))
        form, body = (PLANES, frame) if len(frame) < len(plain) else (PLAIN, plain)
        return bytes([VERSION, form]) + checksum.crc32(plain).to_bytes(4, "little") + body

    def decode(self, data: bytes, dtype: npt.DTypeLike, shape: Sequence[int]) -> np.ndarray:
        """The array, writable. Raises BitstreamError unless `data` is what `encode` wrote for this dtype and shape.

        It takes about three times the memory of the array, however short `data` is: a shape that comes from a file
        must be held against `reader.allow` first.
        """
        wanted = np.dtype(dtype).newbyteorder("<")
        shape = tuple(int(n) for n in shape)
        if wanted.kind not in KINDS or not shape or min(shape) < 0:
            raise ValueError(f"byte planes are of floats or integers [N, ...], not {wanted} {list(shape)}")
        size = math.prod(shape) * wanted.itemsize
        reader = ByteReader(data)
        version, form, crc = reader.integer(1), reader.integer(1), reader.integer(4)
        if version != VERSION or form not in (PLAIN, PLANES):
            raise BitstreamError(f"byte planes of version {version}, form {form} are not known: upgrade sw-codecs")
        body = reader.take(reader.left)
        if form == PLANES:
            planes = np.frombuffer(zstd_frame.decompress(body, size), np.uint8)
            plain = planes.reshape(wanted.itemsize, -1, shape[0]).T.tobytes() if size else b""
        elif len(body) == size:
            plain = bytes(body)
        else:
            raise BitstreamError(f"{len(body):,} bytes of values, {list(shape)} of {wanted} are {size:,}")
        if checksum.crc32(plain) != crc:
            raise BitstreamError("the decoded values do not match their CRC-32")
        return np.frombuffer(plain, wanted).reshape(shape).astype(wanted.newbyteorder("="), copy=True)


class FloatDelta:
    """float32 columns, lossless: steps between successive rows of an order-preserving integer, as byte planes.

    For positions [N, 3] in a spatial order (`FloatDelta.sort(points)`), whose neighbours share sign, exponent and
    leading digits. Every bit pattern comes back: -0.0, denormals, infinities and NaN with its payload.
    """

    sort = staticmethod(spatial_order)

    def encode(self, array: npt.ArrayLike) -> bytes:
        """Bytes of float32 [N, C] or [N], rows in the order in which they come back. Raises ValueError for others.

        The layout is that of `byte-planes` for the steps as u32.
        """
        values = np.asarray(array)
        if values.dtype != np.float32 or values.ndim not in (1, 2):
            raise ValueError(f"float-delta takes float32 [N, C] or [N], not {values.dtype} {list(values.shape)}")
        bits = np.ascontiguousarray(values).view(np.uint32)
        # Ascending floats become ascending integers: negative ones are stored by magnitude, so all bits flip.
        ranks = np.where(bits & SIGN, ~bits, bits | SIGN)
        steps = ranks.copy()
        steps[1:] -= ranks[:-1]  # modulo 2^32
        return BytePlanes().encode((steps << np.uint32(1)) ^ -(steps >> np.uint32(31)))

    def decode(self, data: bytes, dtype: npt.DTypeLike, shape: Sequence[int]) -> np.ndarray:
        """float32 of `shape` (N, C) or (N,), writable. Raises BitstreamError; memory as `byte-planes`.

        Raises ValueError for another dtype.
        """
        if np.dtype(dtype) != np.float32:
            raise ValueError(f"float-delta is of float32, not {np.dtype(dtype)}")
        zigzag = BytePlanes().decode(data, np.uint32, shape)
        steps = (zigzag >> np.uint32(1)) ^ -(zigzag & np.uint32(1))
        ranks = np.cumsum(steps, axis=0, dtype=np.uint32)
        return np.where(ranks & SIGN, ranks ^ SIGN, ~ranks).view(np.float32)


def _planes(plain: bytes, rows: int, itemsize: int) -> list[bytes]:
    """The bytes of each weight, least significant first, column after column: in parts of one plane, or of a weight."""
    if not plain:
        return [b""]
    planes = np.frombuffer(plain, np.uint8).reshape(rows, -1, itemsize).T  # [weight, column, row]
    if rows < OWN_STATISTICS:
        return [weight.tobytes() for weight in planes]
    return [plane.tobytes() for weight in planes for plane in weight]
