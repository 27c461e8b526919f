"""Sizes of files as people write them, as fields of a configuration."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BeforeValidator

from splatwizard_core.api import UserInputError, parse_size


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
