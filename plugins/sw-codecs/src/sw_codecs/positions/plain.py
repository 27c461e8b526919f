"""Two plain position codecs: `raw` (all coordinates, zstd) for tests, `morton-delta` (steps along the Morton curve)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from splatwizard_core.api import BitstreamError
from sw_codecs.bits import checksum, zstd_frame
from sw_codecs.bits.packing import ByteReader, write_varint
from sw_codecs.entropy.columns import Columns
from sw_codecs.positions import morton
from sw_codecs.positions.ordering import spatial_order
from sw_codecs.positions.point_limit import MAX_POINTS, check_written, point_limit

VERSION = 1
LOW_BITS = 48  # a step is coded as two columns, so that each stays within what `columns` takes


def _head(codes: np.ndarray, bits: int) -> bytes:
    """u8 version, u8 bits, u32 CRC-32 of the Morton codes as int64, varint points."""
    return bytes([VERSION, bits]) + checksum.crc32(codes.astype("<i8")).to_bytes(4, "little") + write_varint(len(codes))


def _parse_head(reader: ByteReader, max_points: int) -> tuple[int, int, int]:
    version, bits, crc = reader.integer(1), reader.integer(1), reader.integer(4)
    if version != VERSION or not 1 <= bits <= morton.MAX_BITS:
        raise BitstreamError(f"positions of version {version} with {bits} bits are not known")
    return bits, crc, reader.varint(max_points)


def _checked(codes: np.ndarray, bits: int, crc: int) -> np.ndarray:
    if checksum.crc32(codes.astype("<i8")) != crc:
        raise BitstreamError("the decoded points do not match their CRC-32")
    # Compared, not subtracted: a stranger's codes may be so far apart that their difference wraps around.
    if len(codes) and (codes[0] < 0 or int(codes[-1]) >> (3 * bits) or (codes[1:] < codes[:-1]).any()):
        raise BitstreamError("the decoded points are out of range or not in Morton order")
    return morton.decode(codes)


class RawPositions:
    """Coordinates as u16 (u32 above 16 bits), one axis after the other, zstd level 19."""

    sort = staticmethod(spatial_order)

    def __init__(self, *, max_points: int = MAX_POINTS) -> None:
        self.max_points = max_points

    def encode(self, points: npt.ArrayLike, bits: int) -> bytes:
        """points [N,3] integers, 0 <= p < 2^bits, in Morton order. Raises ValueError if they are not."""
        codes = morton.sorted_codes(points, bits)
        plain = np.asarray(points).T.astype(_coordinate(bits)).tobytes()
        data = _head(codes, bits) + zstd_frame.compress(plain)
        return check_written(len(codes), data, self.max_points)

    def decode(self, data: bytes) -> np.ndarray:
        """[N,3] int64 in Morton order. Raises BitstreamError."""
        reader = ByteReader(data)
        bits, crc, count = _parse_head(reader, point_limit(len(data), self.max_points))
        size = 3 * count * np.dtype(_coordinate(bits)).itemsize
        frame = bytes(reader.take(reader.left))
        plain = zstd_frame.decompress(frame, size)
        points = np.frombuffer(plain, _coordinate(bits)).reshape(3, count).T.astype(np.int64)
        if points.size and points.max() >= 1 << bits:
            raise BitstreamError("a coordinate is out of range")
        return _checked(morton.encode(points), bits, crc)


def _coordinate(bits: int) -> str:
    return "<u2" if bits <= 16 else "<u4"


class MortonDelta:
    """Differences of successive Morton codes with the `columns` model: near the octree, twice as fast to write."""

    sort = staticmethod(spatial_order)

    def __init__(self, *, max_points: int = MAX_POINTS) -> None:
        self.max_points = max_points

    def encode(self, points: npt.ArrayLike, bits: int) -> bytes:
        """points [N,3] integers, 0 <= p < 2^bits, in Morton order. Raises ValueError if they are not."""
        codes = morton.sorted_codes(points, bits)
        steps = np.diff(codes, prepend=0)
        columns = np.stack([steps >> LOW_BITS, steps & ((1 << LOW_BITS) - 1)], 1)
        return check_written(len(codes), _head(codes, bits) + Columns().encode(columns), self.max_points)

    def decode(self, data: bytes) -> np.ndarray:
        """[N,3] int64 in Morton order. Raises BitstreamError."""
        reader = ByteReader(data)
        bits, crc, count = _parse_head(reader, point_limit(len(data), self.max_points))
        high, low = Columns().decode(bytes(reader.take(reader.left)), (count, 2)).T
        return _checked(np.cumsum((high << LOW_BITS) + low), bits, crc)
