"""Compression methods of zip members that can be read piece by piece.

Python's zipfile hands a block of bzip2 or LZMA to its decoder without a limit: a read of one byte may unpack gigabytes.
"""

from __future__ import annotations

import zipfile

METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


def check_method(info: zipfile.ZipInfo) -> None:
    """Raise ValueError unless a member is stored or deflated."""
    if info.compress_type not in METHODS:
        name = zipfile.compressor_names.get(info.compress_type, "an unknown method")  # type: ignore[attr-defined]
        raise ValueError(f"{info.filename!r} is compressed by {name}: pack it again with deflate, or as a tar")
