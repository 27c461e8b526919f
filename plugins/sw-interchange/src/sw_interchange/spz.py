"""The .spz format of Niantic: planes of bytes, gzip (versions 1 to 3) or zstd (4) around them.

Source: the public description in nianticlabs/spz.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from splatwizard_core.api import BitstreamError, UserInputError
from sw_interchange import spz_packing as packing
from sw_interchange.options import Options
from sw_interchange.scene import GaussianScene, Limits, ReadReport, WriteReport
from sw_interchange.source import Source
from sw_interchange.spz_fields import decode_fields, encode_fields, field_sizes

MAGIC = b"NGSP"
ANTIALIASED, EXTENDED, LOD_TREE = 0x01, 0x02, 0x80
EXTENSION_SLACK = 1 << 20
"""Bytes after the attributes that a file of versions 1 to 3 may hold."""
MAX_EXTENSIONS = 64
AXES_EXTENSION = 0xADBE0003
_AXES = ["LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF", "LFD", "RFD", "LFU", "RFU", "LBD", "RBD", "LBU", "RBU"]


class SpzOptions(Options):
    """Options of `.spz`.

    version         3 is read most widely, 4 is smaller and quicker; 2 has coarse rotations
    fractional_bits of a coordinate; less where the scene is larger than 2^(23 - bits)
    sh1_bits, sh_bits  of a coefficient of band 1, of the others
    level           of the compressor, 1 to 9 of gzip (version 2 and 3), 1 to 22 of zstd (version 4); None: 3
    frame           "RUB", or "raw": the numbers as they are in a .ply
    antialiased     None: as the scene says
    """

    version: int = 3
    fractional_bits: int = 12
    sh1_bits: int = 5
    sh_bits: int = 4
    level: int | None = None
    frame: str = "RUB"
    antialiased: bool | None = None
    choices = {
        "version": (2, 3, 4), "fractional_bits": range(25), "sh1_bits": range(1, 9), "sh_bits": range(1, 9),
        "level": (None, *range(1, 23)), "frame": ("RUB", "raw"), "antialiased": (None, True, False),
    }  # fmt: skip

    def __init__(self, **values: Any) -> None:
        super().__init__(**values)
        if self.version < 4 and (self.level or 0) > packing.GZIP_LEVELS:
            raise UserInputError(
                f"option 'level' is {self.level}; version {self.version} is gzip, whose levels end at "
                f"{packing.GZIP_LEVELS}: version=4 is zstd, with levels up to 22"
            )


@dataclass
class _Header:
    version: int
    count: int
    degree: int
    fractional_bits: int
    flags: int
    extensions: bytes = b""
    planes: list[Any] = field(default_factory=list)


def read_spz(source: Source, limits: Limits, report: ReadReport) -> GaussianScene:
    """Decode a file of versions 1 to 4. Raises BitstreamError."""
    head = source.head(16)
    if head[:4] == MAGIC and len(head) == 16 and head[4:8] == b"\4\0\0\0":
        header = _open_4(source, limits)
    else:
        header = _open_123(source, limits)
    report.version = str(header.version)
    if unknown := header.flags & ~(ANTIALIASED | EXTENDED):
        report.warnings.append(f"flags 0x{unknown:02x} of the file mean nothing here")
    frame, meta = _extensions(header, source, report)
    scene = decode_fields(header.planes, header.count, header.version, header.degree, header.fractional_bits)
    return replace(scene, frame=frame, antialiased=bool(header.flags & ANTIALIASED), meta=meta)


def _parse_head(head: bytes, name: str) -> _Header:
    if len(head) < 16 or head[:4] != MAGIC:
        raise BitstreamError(f"{name}: not a .spz file", section="header")
    version, count, degree, bits, flags, _ = struct.unpack("<IIBBBB", head[4:16])
    if not 1 <= version <= 4:
        raise BitstreamError(f"{name}: version {version} of .spz; 1 to 4 are read", section="header")
    if not 1 <= count < 1 << 31:
        raise BitstreamError(f"{name}: the header claims {count:,} Gaussians", section="header")
    if degree > 4 or bits > 24:
        raise BitstreamError(
            f"{name}: the header claims SH degree {degree} and {bits} fractional bits; 4 and 24 are the most",
            section="header",
        )
    if flags & LOD_TREE:
        raise BitstreamError(f"{name}: there is a tree of levels of detail inside, which is not read", section="header")
    return _Header(version, count, degree, bits, flags)


def _open_123(source: Source, limits: Limits) -> _Header:
    """Versions 1 to 3: one gzip stream (or the same without gzip)."""
    name = source.name
    packed = source.data[:2] == b"\x1f\x8b"
    head = packing.inflate(source.data, 16, name) if packed else source.head(16)
    header = _parse_head(bytes(head[:16]), name)
    if header.version > 3:
        raise BitstreamError(f"{name}: version {header.version} is not gzipped", section="header")
    sizes = field_sizes(header.count, header.version, header.degree)
    whole = 16 + sum(sizes)
    limits.check(header.count, whole, name, len(source.data))
    # Deflate makes at most 1032 bytes of one: a count beyond that is a lie, told before anything is allocated.
    if whole > len(source.data) * (1032 if packed else 1):
        raise BitstreamError(f"{name}: claims {header.count:,} Gaussians, too many for its size: it is truncated")
    content = packing.inflate(source.data, whole + EXTENSION_SLACK, name) if packed else source.data
    if len(content) < whole:
        raise BitstreamError(f"{name}: {len(content):,} of {whole:,} bytes are there: the file is truncated")
    at = 16
    for size in sizes:
        header.planes.append(memoryview(content)[at : at + size])
        at += size
    header.extensions = bytes(content[at : at + EXTENSION_SLACK])
    return header


def _open_4(source: Source, limits: Limits) -> _Header:
    """Version 4: a plain header, a table of contents, and a zstd frame for each attribute."""
    name, data = source.name, source.data
    if len(data) < 32:
        raise BitstreamError(f"{name}: {len(data)} bytes are no .spz: it is truncated", section="header")
    header = _parse_head(source.head(16), name)
    streams, start = data[15], int.from_bytes(data[16:20], "little")
    sizes = [size for size in field_sizes(header.count, 4, header.degree) if size]
    if streams != len(sizes):
        raise BitstreamError(f"{name}: {streams} streams, degree {header.degree} has {len(sizes)}", section="header")
    if header.count > _most_claimed(len(data)):
        raise BitstreamError(f"{name}: claims {header.count:,} Gaussians, too many for its size", section="header")
    limits.check(header.count, sum(sizes), name, len(data))
    at = start + 16 * streams
    if start < 32 or at > len(data):
        raise BitstreamError(f"{name}: its table of contents lies outside of the file", section="contents")
    table = struct.unpack(f"<{2 * streams}Q", data[start:at])
    if list(table[1::2]) != sizes or at + sum(table[::2]) != len(data):
        raise BitstreamError(f"{name}: its table of contents does not fit the file", section="contents")
    frames = []
    for packed in table[::2]:
        frames.append(data[at : at + packed])
        at += packed
    header.planes = packing.unzstd(frames, sizes, name)
    header.extensions = bytes(data[32 : min(start, 32 + EXTENSION_SLACK)])
    return header


def _most_claimed(size: int) -> int:
    """Gaussians that a file of version 4 and so many bytes may claim to hold, for the reader of Niantic as well."""
    return size * 1024 // 9


def _extensions(header: _Header, source: Source, report: ReadReport) -> tuple[str, dict[str, Any]]:
    """The axes of the numbers, and the other extensions as raw bytes."""
    frame = "RDF" if source.spz_frame == "raw" else source.spz_frame
    meta: dict[str, Any] = {}
    records = header.extensions if header.flags & EXTENDED else b""
    at = found = 0
    while at < len(records):
        if found == MAX_EXTENSIONS:
            raise BitstreamError(f"{source.name}: more than {MAX_EXTENSIONS} extensions", section="extensions")
        if len(records) < at + 8:
            raise BitstreamError(f"{source.name}: an extension is cut off", section="extensions")
        kind, length = struct.unpack_from("<II", records, at)
        payload = records[at + 8 : at + 8 + length]
        if len(payload) != length:
            raise BitstreamError(f"{source.name}: extension 0x{kind:08x} is cut off", section="extensions")
        at, found = at + 8 + length, found + 1
        if kind == AXES_EXTENSION and length == 4:
            code = int.from_bytes(payload, "little")
            if 1 <= code <= 16:
                frame = _AXES[code - 1]
            else:
                report.warnings.append(f"it claims the axes number {code}, which there are not: taken as {frame}")
        else:
            meta.setdefault("spz_extensions", []).append((kind, payload))
            report.ignored.append(f"extension 0x{kind:08x} ({length:,} bytes)")
    return frame, meta


def write_spz(scene: GaussianScene, options: SpzOptions, report: WriteReport) -> list[bytes]:
    """Encode a scene in RDF. Raises UserInputError for one too large for any number of fractional bits."""
    if scene.sh_degree > 3 and options.version < 4:
        report.lost.append("SH degree 4: version 4 holds it")
        scene = scene.with_degree(3)
    bits = _fractional_bits(scene, options, report)
    planes = encode_fields(scene, options, bits, report)
    antialiased = scene.antialiased if options.antialiased is None else options.antialiased
    flags = ANTIALIASED if antialiased else 0
    head = MAGIC + struct.pack("<IIBBB", options.version, scene.num_gaussians, scene.sh_degree, bits, flags)
    if options.version < 4:
        return packing.deflate([head + b"\0", *planes], options.level or 3)
    planes = [plane for plane in planes if len(plane)]
    frames = packing.zstd(planes, options.level or 3)
    size = sum(map(len, frames))
    # Equal Gaussians: no reader would believe so few bytes.
    if scene.num_gaussians > _most_claimed(size):
        frames[1] = packing.stored(planes[1])
    table = b"".join(struct.pack("<QQ", len(frame), len(plane)) for frame, plane in zip(frames, planes, strict=True))
    return [head + struct.pack("<BI", len(planes), 32) + bytes(12) + table, *frames]


def _fractional_bits(scene: GaussianScene, options: SpzOptions, report: WriteReport) -> int:
    """As many as are asked for, fewer where 24 bits do not reach to the end of the scene."""
    largest = float(np.abs(scene.means).max())
    room = 24 if largest == 0 else math.floor(math.log2(((1 << 23) - 1) / largest))
    if room < 0:
        raise UserInputError(f"the scene reaches to {largest:.3g}: .spz holds coordinates up to 8,388,607")
    if room < options.fractional_bits:
        report.warnings.append(f"coordinates reach to {largest:.4g}: {room} fractional bits instead of "
                               f"{options.fractional_bits}")  # fmt: skip
    bits = min(room, options.fractional_bits)
    report.coarse(np.float64(2.0**-bits), scene.means, scene.log_scales)
    return bits
