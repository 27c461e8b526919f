"""Sizes of files as people write them."""

from __future__ import annotations

import re
from typing import Annotated, Any

from pydantic import BeforeValidator

from splatwizard_core.api import UserInputError

UNITS = {
    "": 1, "b": 1, "kb": 10**3, "mb": 10**6, "gb": 10**9, "kib": 1 << 10, "mib": 1 << 20, "gib": 1 << 30,
}  # fmt: skip
LARGEST = 1 << 50


def parse_size(text: str | int) -> int:
    """Return bytes of `8MB` (10^6), `8MiB` (2^20), `800kB` or a number of bytes. Raises UserInputError."""
    match = re.fullmatch(r"\s*([0-9]+(?:\.[0-9]*)?|\.[0-9]+)\s*([a-zA-Z]*)\s*", str(text))
    if match is None or match[2].lower() not in UNITS:
        raise UserInputError(f"size '{text}' is none: give bytes, or a number with kB, MB, GB, KiB, MiB or GiB: 8MB")
    found = float(match[1]) * UNITS[match[2].lower()]
    if not 1 <= found <= LARGEST:
        raise UserInputError(f"size '{text}' must be 1 byte to {LARGEST >> 40:,} TiB")
    return int(found)


def _checked(value: Any) -> str:
    if value == "":
        return ""
    try:
        parse_size(value)
    except UserInputError:
        raise ValueError("bytes, or a number with kB, MB, GB, KiB, MiB or GiB") from None
    return str(value)


ByteSize = Annotated[str, BeforeValidator(_checked)]
"""Field type of a size as people write it; empty: none."""
