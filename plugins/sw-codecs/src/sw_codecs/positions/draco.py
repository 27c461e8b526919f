"""Position codec `draco`: integer points by the Draco library, near the octree in size; the extra `sw-codecs[draco]`.

Draco loses the order of points and merges equal ones, so both sides sort, and how often each point occurs is coded
apart. Its decoder is not made for files from strangers: a few changed bytes let it run for minutes or fill the memory,
so it works in a process of its own with a limit on both (`draco_process`), which costs a tenth of a second.

Layout (docs/bitstream.md): u8 version, u8 bits, u32 CRC-32 of the Morton codes as int64, varint points, varint distinct
points; if there are any, varint length, u32 CRC-32 and bytes of the Draco file, then the duplicates.
"""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import numpy.typing as npt

from splatwizard_core.api import BitstreamError, CapabilityError
from sw_codecs.bits import checksum
from sw_codecs.bits.packing import ByteReader, write_varint
from sw_codecs.positions import morton
from sw_codecs.positions.duplicates import decode_duplicates, encode_duplicates, without_duplicates
from sw_codecs.positions.ordering import spatial_order
from sw_codecs.positions.point_limit import MAX_POINTS, check_written, point_limit

VERSION = 1
LEVEL = 7
HEAD = 15  # magic, version, kind, method, flags, number of points
PROCESS = Path(__file__).with_name("draco_process.py")
MEMORY = 1 << 30  # bytes of address space that numpy and the library take by themselves, generously
MEMORY_PER_POINT = 512
SECONDS, SECONDS_PER_POINT = 5, 2e-5


def unavailable() -> str | None:
    """Reason why Draco cannot be used here, or None; imports nothing."""
    if importlib.util.find_spec("DracoPy") is None:
        return "not installed: pip install 'sw-codecs[draco]'"
    return None


def _draco() -> ModuleType:
    try:
        import DracoPy
    except ImportError as error:
        raise CapabilityError(
            f"positions by Draco need the package DracoPy ({error}): pip install 'sw-codecs[draco]'",
            missing=["DracoPy"],
        ) from error
    return DracoPy


class Draco:
    """Codes [N,3] integer points, up to 21 bits an axis; duplicates are kept.

    max_points  `decode` refuses files that claim more

    `encode` and `decode` raise CapabilityError where DracoPy is not installed.
    """

    sort = staticmethod(spatial_order)

    def __init__(self, *, max_points: int = MAX_POINTS) -> None:
        self.max_points = max_points

    def encode(self, points: npt.ArrayLike, bits: int) -> bytes:
        """points [N,3] integers, 0 <= p < 2^bits, in Morton order. Raises ValueError if they are not."""
        draco = _draco()
        codes = morton.sorted_codes(points, bits)
        distinct, extra = without_duplicates(codes)
        head = bytes([VERSION, bits]) + checksum.crc32(codes.astype("<i8")).to_bytes(4, "little")
        out = head + write_varint(len(codes)) + write_varint(len(distinct))
        if len(distinct):
            file = draco.encode(
                morton.decode(distinct).astype(np.float32),
                quantization_bits=bits,
                compression_level=LEVEL,
                quantization_range=(1 << bits) - 1,
                quantization_origin=[0, 0, 0],
            )
            file_crc = checksum.crc32(file).to_bytes(4, "little")
            out += write_varint(len(file)) + file_crc + file + encode_duplicates(extra)
        return check_written(len(codes), out, self.max_points)

    def decode(self, data: bytes) -> np.ndarray:
        """[N,3] int64 in Morton order. Raises BitstreamError, in bounded time and memory."""
        _draco()
        reader = ByteReader(data)
        version, bits, crc = reader.integer(1), reader.integer(1), reader.integer(4)
        if version != VERSION or not 1 <= bits <= morton.MAX_BITS:
            raise BitstreamError(f"positions by Draco of version {version} with {bits} bits are not known")
        count = reader.varint(point_limit(len(data), self.max_points))
        distinct = reader.varint(count)
        if (count == 0) != (distinct == 0):
            raise BitstreamError(f"{count:,} points, but {distinct:,} distinct ones")
        codes = np.empty(0, np.int64)
        if distinct:
            length = reader.varint(reader.left)
            file_crc, file = reader.integer(4), bytes(reader.take(length))
            if checksum.crc32(file) != file_crc:
                raise BitstreamError("the Draco data do not match their CRC-32")
            times = decode_duplicates(reader, count, distinct)
            codes = np.repeat(np.sort(morton.encode(_decoded(file, distinct, bits))), times)
        reader.finish()
        if checksum.crc32(codes.astype("<i8")) != crc:
            raise BitstreamError("the decoded points do not match their CRC-32")
        return morton.decode(codes)


def _decoded(file: bytes, count: int, bits: int) -> np.ndarray:
    """The `count` points of a Draco file, int64 [count, 3] in any order, decoded in a process of its own."""
    if len(file) < HEAD or file[:5] != b"DRACO" or int.from_bytes(file[HEAD - 4 : HEAD], "little") != count:
        raise BitstreamError(f"this is no Draco file of {count:,} points")
    seconds = int(SECONDS + SECONDS_PER_POINT * count)
    limits = [str(MEMORY + MEMORY_PER_POINT * count), str(seconds), str(count)]
    try:
        # One thread: each would reserve address space of its own.
        child = subprocess.run(
            [sys.executable, "-I", str(PROCESS), *limits],
            input=file,
            capture_output=True,
            timeout=60 + 10 * seconds,
            env=os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
        )
    except subprocess.TimeoutExpired as error:
        raise BitstreamError("Draco does not come to an end with these data: they are damaged") from error
    if child.returncode or len(child.stdout) != 12 * count:
        said = child.stderr.decode(errors="replace").strip().splitlines()
        reason = said[-1] if said else f"its process ended with {child.returncode}"
        raise BitstreamError(f"Draco refuses these data: {reason}")
    points = np.frombuffer(child.stdout, "<i4").reshape(count, 3).astype(np.int64)
    if points.min() < 0 or points.max() >= 1 << bits:
        raise BitstreamError("a coordinate is out of range")
    return points
