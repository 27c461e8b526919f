"""The bytes of a file, and what errors call it."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sw_gaussians.memory_map import memory_map

from splatwizard_core.api import BitstreamError, SceneError
from splatwizard_core.tooling import json_reason as json_reason


@dataclass(frozen=True)
class Source:
    """Bytes to decode.

    data    all of them; of a file a view of the pages that the system holds
    path    where they lie, if they lie anywhere: files beside it may belong to it
    name    for messages
    spz_frame, level, sh_layout     options of the reader: see `files.read`
    """

    data: bytes | memoryview
    name: str
    path: Path | None = None
    spz_frame: str = "RUB"
    level: int = 0
    sh_layout: str = "planar"

    @classmethod
    def open(cls, path: str | os.PathLike[str], **options: Any) -> Source:
        """Map a file. Raises SceneError if it cannot be read."""
        where = Path(path)
        return cls(memory_map(where), where.name, where, **options)

    def beside(self, name: str) -> bytes | memoryview:
        """Map another file of the same folder, a plain name; links are followed. Raises BitstreamError."""
        if self.path is None:
            raise BitstreamError(f"{self.name}: '{name}' belongs to it and lies in another file: read them in place")
        where = self.path.parent / name
        try:
            return memory_map(where)
        except SceneError as error:
            reason = str(error).removeprefix(f"{where}: ")
            raise BitstreamError(f"{self.name}: '{name}', which belongs to it, {reason}") from error

    def head(self, count: int) -> bytes:
        """The first bytes, at most `count`."""
        return bytes(self.data[:count])
