"""Chapter 1: Container."""

from __future__ import annotations

import itertools
import json
import zlib
from typing import Any

import numpy as np

from bitstream_page.fields import Bytes, check


def container(data: bytes) -> tuple[dict[str, Any], dict[str, bytes]]:
    """The header and the sections."""
    file = Bytes(data)
    check(file.take(4) == b"SPWZ", "not a .swz")
    version = file.one("H")
    check(version in (1, 2), "not version 1 or 2 of .swz")
    raw = file.take(file.one("I"))
    check(zlib.crc32(raw) == file.one("I"), "header CRC")
    header = json.loads(raw)
    keys = {"method", "method_version", "requires", "raster", "static", "sections", *(["cuts"] if version == 2 else [])}
    check(set(header) | {"requires"} == keys, "keys")
    sections, expected = {}, 0
    for name, offset, length, crc in header["sections"][: there(header, len(data) - file.at)]:
        check(offset == expected, "offset")
        sections[name] = file.take(length)
        check(zlib.crc32(sections[name]) == crc, f"CRC of {name}")
        expected += length
    file.done()
    return header, sections


def there(header: dict[str, Any], length: int) -> int | None:
    """Number of sections that a file with so many bytes of them has; None: all."""
    if "cuts" not in header:
        return None
    sums = np.cumsum([0, *(row[2] for row in header["sections"])]).tolist()
    cuts = [(0, 0), *((sections, size) for sections, size, _ in header["cuts"])]
    check(all(size == sums[sections] for sections, size in cuts), "a cut inside of a section")
    check(all(a < c and b < d for (a, b), (c, d) in itertools.pairwise(cuts)), "cuts grow")
    check(cuts[-1][0] == len(sums) - 1, "the last cut")
    found = [sections for sections, size in cuts[1:] if size == length]
    check(len(found) == 1, "the file ends at no cut")
    return found[0]


DTYPES = dict(enumerate(["u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f2", "f4", "f8", "b1"], 1))


def array(section: bytes) -> np.ndarray:
    data = Bytes(section)
    dtype, axes = data.unpack("BB")
    shape = data.unpack("I" * axes)
    return np.frombuffer(data.rest(), "<" + DTYPES[dtype]).reshape(shape)
