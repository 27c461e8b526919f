"""A file with parts of somebody's choice, whose checksums are right: for tests of what a decoder refuses.

from sw_kit.forged_files import forged
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from splatwizard_core.api import ContainerReader, ContainerWriter


def forged(data: bytes, sections: Mapping[str, bytes | None] | None = None, **static: Any) -> bytes:
    """Return the bytes of a .swz file with other sections and header values.

    sections    name -> its content in place of the file's; None: without it
    static      values of the header in place of the file's
    """
    reader = ContainerReader(data)
    writer = ContainerWriter(reader.method, reader.version, raster=reader.raster)
    writer.static.update({**reader.static, **static})
    for name, content in {**{name: reader.section(name) for name in reader.sections}, **(sections or {})}.items():
        if content is not None:
            writer.add(name, content)
    return writer.to_bytes()
