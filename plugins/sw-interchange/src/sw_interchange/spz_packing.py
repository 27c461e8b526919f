"""Gzip and zstd around the planes of .spz: bounded when they are read, in two threads where that pays.

zlib-ng inflates and deflates the same streams two to three times faster than zlib (benchmarks/interchange.py).
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence

from splatwizard_core.api import BitstreamError
from sw_interchange.threads import each_of

try:
    from zlib_ng import zlib_ng as gzip_codec
except ImportError:  # no wheel for this machine
    import zlib as gzip_codec

BLOCK = 1 << 22
"""Bytes that one thread deflates at a time."""
GZIP_LEVELS = 9
_HEAD = b"\x1f\x8b\x08\0\0\0\0\0\0\xff"
_GZIP = 16 + zlib.MAX_WBITS


def inflate(data: bytes | memoryview, most: int, name: str) -> bytes:
    """Inflate a gzip stream, at most `most` bytes of it, whatever it claims. Raises BitstreamError."""
    decoder = gzip_codec.decompressobj(wbits=_GZIP)
    try:
        content = bytes(decoder.decompress(data, most))
        if len(content) < most and not decoder.eof:
            raise BitstreamError(f"{name}: its gzip stream does not end: the file is truncated")
        return content
    except (zlib.error, gzip_codec.error) as error:
        raise BitstreamError(f"{name}: damaged gzip stream: {error}") from error


def deflate(parts: Sequence[bytes | memoryview], level: int) -> list[bytes]:
    """One gzip member of all parts: blocks deflated by two threads, each ended so that the next can follow."""
    content = b"".join(parts)
    blocks = [memoryview(content)[at : at + BLOCK] for at in range(0, len(content), BLOCK)]

    def packed(block: memoryview) -> bytes:
        encoder = gzip_codec.compressobj(level, zlib.DEFLATED, -zlib.MAX_WBITS)
        mode = zlib.Z_FINISH if block is blocks[-1] else zlib.Z_SYNC_FLUSH
        return bytes(encoder.compress(block) + encoder.flush(mode))

    streams = each_of(packed, blocks)
    return [_HEAD, *streams, struct.pack("<II", gzip_codec.crc32(content), len(content) & 0xFFFFFFFF)]


def unzstd(frames: Sequence[bytes | memoryview], sizes: Sequence[int], name: str) -> list[bytes]:
    """Decompress one zstd frame for each plane, of exactly its size. Raises BitstreamError."""
    import zstandard

    def plain(part: tuple[bytes | memoryview, int]) -> bytes:
        frame, size = part
        try:
            told = zstandard.frame_content_size(frame)
            if told not in (size, -1):
                raise BitstreamError(f"{name}: a stream decodes to {told:,} bytes, expected are {size:,}")
            # Into memory of that size: a few bytes of a frame may stand for 128 KiB, however it is cut.
            content = zstandard.ZstdDecompressor(max_window_size=1 << 27).decompress(frame, max_output_size=size)
        except zstandard.ZstdError as error:
            raise BitstreamError(f"{name}: no zstd stream of {size:,} bytes: {error}") from error
        if len(content) != size:
            raise BitstreamError(f"{name}: a stream decodes to {len(content):,} bytes, expected are {size:,}")
        return content

    return each_of(plain, list(zip(frames, sizes, strict=True)))


def stored(plane: bytes | memoryview) -> bytes:
    """Return a zstd frame that holds the plane as it is, in blocks of 128 KiB."""
    parts = [struct.pack("<IBQ", 0xFD2FB528, 0xE0, len(plane))]  # one segment, its size in eight bytes
    for at in range(0, len(plane), 1 << 17):
        block = plane[at : at + (1 << 17)]
        parts += [struct.pack("<I", len(block) << 3 | (at + len(block) == len(plane)))[:3], bytes(block)]
    return b"".join(parts)


def zstd(planes: Sequence[bytes | memoryview], level: int) -> list[bytes]:
    """One zstd frame for each plane, with its size in it."""
    import zstandard

    return each_of(lambda plane: zstandard.ZstdCompressor(level=level).compress(plane), planes)
