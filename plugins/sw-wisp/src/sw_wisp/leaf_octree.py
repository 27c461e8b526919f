"""Position codec `leaf-octree` by itself: integer points in the octree that packets of wisp begin with.

Points sit at one level, the coarsest of 3 to 18 at which all of them are told apart, if there is one; bits of their
codes below that level follow as they are. Of points in one cell the octree has one, and how many more there are
follows, since a cell of wisp has room for 16. Points of 1 or 2 bits an axis lie in the low corners of cells of level 3.

Layout: u8 version, u8 bits an axis, u8 level, varint points, varint occupied cells; if there are any, the probabilities
(`octree_contexts.Shares`), varint length and words of `nested`, further points of a cell (`duplicates`), the raw bits;
u32 CRC-32 of the points' Morton codes as i64.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from splatwizard_core.api import BitstreamError
from sw_codecs.bits import checksum
from sw_codecs.bits.packing import ByteReader, pack_fixed, packed_size, unpack_fixed, write_varint
from sw_codecs.positions import morton
from sw_codecs.positions.duplicates import decode_duplicates, encode_duplicates, without_duplicates
from sw_codecs.positions.ordering import spatial_order
from sw_codecs.positions.point_limit import MAX_POINTS, check_written, point_limit
from sw_wisp.fast.streams import reader_of
from sw_wisp.nested import Writer
from sw_wisp.numbers import HIGHEST_LEVEL, LOWEST_LEVEL
from sw_wisp.octree import Cells, code_cells, fit_shares, joined
from sw_wisp.octree_contexts import Shares

VERSION = 1


class LeafOctree:
    """Codes [N,3] integer points, up to 21 bits an axis; duplicates are kept.

    max_points  `decode` refuses files that claim more
    """

    sort = staticmethod(spatial_order)

    def __init__(self, *, max_points: int = MAX_POINTS) -> None:
        self.max_points = max_points

    def encode(self, points: npt.ArrayLike, bits: int) -> bytes:
        """points [N,3] integers, 0 <= p < 2^bits, in Morton order (`sort`).

        Raises ValueError if they are not, SplatwizardError for more points than a reader accepts (`point_limit`).
        """
        codes = morton.sorted_codes(points, bits)
        level = _level(codes, bits)
        deeper = 3 * (max(bits, level) - level)
        wide = _at_least_three_bits(codes, bits)
        cells, more = without_duplicates(wide >> deeper)
        out = bytes([VERSION, bits, level]) + write_varint(len(codes)) + write_varint(len(cells))
        if len(cells):
            subset, stream = Cells(np.full(len(cells), level), cells), Writer()
            shares = fit_shares([subset])
            code_cells(stream, shares, len(cells), joined([]), subset)
            words = stream.finish()
            out += shares.pack() + write_varint(len(words)) + words + encode_duplicates(more)
            out += pack_fixed((wide & ((1 << deeper) - 1)).astype(np.uint64), deeper)
        return check_written(len(codes), out + _crc(codes).to_bytes(4, "little"), self.max_points)

    def decode(self, data: bytes) -> np.ndarray:
        """[N,3] int64 in Morton order. Raises BitstreamError, in time and memory bounded by `max_points`."""
        reader = ByteReader(data)
        version, bits, level = reader.integer(1), reader.integer(1), reader.integer(1)
        if version != VERSION:
            raise BitstreamError(f"leaf octree of version {version} is not known: upgrade sw-wisp")
        if not 1 <= bits <= morton.MAX_BITS or not LOWEST_LEVEL <= level <= min(HIGHEST_LEVEL, max(bits, LOWEST_LEVEL)):
            raise BitstreamError(f"points of {bits} bits an axis at level {level} of the octree")
        count = reader.varint(point_limit(len(data), self.max_points))
        distinct = reader.varint(count)
        if (count == 0) != (distinct == 0):
            raise BitstreamError(f"{count:,} points, but {distinct:,} occupied cells")
        codes = np.empty(0, np.int64)
        if distinct:
            shares = Shares.unpack(reader)
            stream = reader_of(reader.take(reader.varint(reader.left)))
            found = code_cells(stream, shares, distinct, joined([]), None)
            stream.finish()
            if (found.levels != level).any() or (np.diff(found.codes) <= 0).any():
                raise BitstreamError("the octree holds other cells than single ones of its level")
            deeper = 3 * (max(bits, level) - level)
            codes = np.repeat(found.codes, decode_duplicates(reader, count, distinct)) << deeper
            codes |= unpack_fixed(reader.take(packed_size(count, deeper)), count, deeper).view(np.int64)
            codes >>= 3 * max(LOWEST_LEVEL - bits, 0)
        crc = reader.integer(4)
        reader.finish()
        if _crc(codes) != crc:
            raise BitstreamError("the decoded points do not match their CRC-32")
        return morton.decode(codes)


def _level(codes: np.ndarray, bits: int) -> int:
    """Level of the octree at which points with ascending codes sit."""
    finest = min(max(bits, LOWEST_LEVEL), HIGHEST_LEVEL)
    if len(codes) < 2 or bits <= LOWEST_LEVEL:
        return LOWEST_LEVEL
    apart = codes[1:] ^ codes[:-1]
    closest = int(apart[apart > 0].min(initial=(1 << 3 * bits) - 1))  # its highest bit tells them apart
    return min(max(bits - (closest.bit_length() - 1) // 3, LOWEST_LEVEL), finest)


def _at_least_three_bits(codes: np.ndarray, bits: int) -> np.ndarray:
    """Codes of the low corners of the points' cells at level 3 or finer."""
    wide: np.ndarray = codes << 3 * max(LOWEST_LEVEL - bits, 0)
    return wide


def _crc(codes: np.ndarray) -> int:
    return checksum.crc32(codes.astype("<i8", copy=False))
