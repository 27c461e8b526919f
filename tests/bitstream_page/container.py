"""Chapter 1: Container."""

from __future__ import annotations

import json
import zlib
from typing import Any

import numpy as np

from bitstream_page.fields import Bytes, check


def container(data: bytes) -> tuple[dict[str, Any], dict[str, bytes]]:
    """The header and the sections."""
    file = Bytes(data)
    check(file.take(4) == b"SPWZ" and file.one("H") == 1, "not version 1 of .swz")
    raw = file.take(file.one("I"))
    check(zlib.crc32(raw) == file.one("I"), "header CRC")
    header = json.loads(raw)
    check(
        set(header) | {"requires"} == {"method", "method_version", "requires", "raster", "static", "sections"}, "keys"
    )
    sections, expected = {}, 0
    for name, offset, length, crc in header["sections"]:
        check(offset == expected, "offset")
        sections[name] = file.take(length)
        check(zlib.crc32(sections[name]) == crc, f"CRC of {name}")
        expected += length
    file.done()
    return header, sections


DTYPES = dict(enumerate(["u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f2", "f4", "f8", "b1"], 1))


def array(section: bytes) -> np.ndarray:
    data = Bytes(section)
    dtype, axes = data.unpack("BB")
    shape = data.unpack("I" * axes)
    return np.frombuffer(data.rest(), "<" + DTYPES[dtype]).reshape(shape)
