"""One zstd frame whose length both sides know: what it decodes to is never longer than the caller allows."""

from __future__ import annotations

import zstandard

from splatwizard_core.api import BitstreamError

LEVEL = 19
LONGEST_EMPTY = 32  # bytes of a frame that holds none: header, one block, checksum


def compress(*parts: bytes) -> bytes:
    """A frame that states its content size. Each part gets blocks, thus symbol statistics, of its own."""
    stream = zstandard.ZstdCompressor(level=LEVEL).compressobj(size=sum(map(len, parts)))
    out = []
    for part in parts[:-1]:
        out += [stream.compress(part), stream.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK)]
    return b"".join([*out, stream.compress(parts[-1]), stream.flush()])


def decompress(frame: bytes | memoryview, size: int) -> bytes:
    """The `size` bytes in `frame`. Raises BitstreamError, before any memory is taken, if it holds another number."""
    try:
        if zstandard.frame_content_size(frame) != size:
            raise BitstreamError(f"a zstd frame does not hold the {size:,} bytes that are expected")
        if size == 0:  # the library answers from the header alone, however the frame goes on
            stream = zstandard.ZstdDecompressor().decompressobj()
            plain = stream.decompress(frame[:LONGEST_EMPTY])
            if not stream.eof or stream.unused_data or len(frame) > LONGEST_EMPTY:
                raise BitstreamError("a zstd frame of no bytes is damaged")
        else:
            plain = zstandard.ZstdDecompressor().decompress(frame, max_output_size=size, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise BitstreamError(f"a zstd frame is damaged: {error}") from error
    if len(plain) != size:
        raise BitstreamError(f"a zstd frame does not hold the {size:,} bytes that are expected")
    return plain
