"""Members of ZIP archives from strangers, each bounded before it is decompressed."""

from __future__ import annotations

import io
import zipfile
import zlib

from splatwizard_core.api import BitstreamError
from sw_interchange.source import Source

MAX_MEMBERS = 64


def names_in(source: Source) -> list[str]:
    """Names of all members. Raises BadZipFile."""
    return [info.filename for info in _opened(source).infolist()]


def entries_of(source: Source) -> list[zipfile.ZipInfo]:
    """Entries of the central directory. Raises BadZipFile."""
    return _opened(source).infolist()


def _opened(source: Source) -> zipfile.ZipFile:
    return zipfile.ZipFile(_View(source.data))


class _View(io.RawIOBase):
    """A seekable file over bytes that are not copied."""

    def __init__(self, data: bytes | memoryview) -> None:
        self._data, self._at = memoryview(data), 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        base = {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: len(self._data)}[whence]
        if base + offset < 0:
            raise ValueError("before the beginning")
        self._at = base + offset
        return self._at

    def tell(self) -> int:
        return self._at

    def readinto(self, buffer: bytearray | memoryview) -> int:  # type: ignore[override]
        piece = self._data[self._at : self._at + len(buffer)]
        buffer[: len(piece)] = piece
        self._at += len(piece)
        return len(piece)


def read_archive(source: Source, limit: int) -> dict[str, bytes]:
    """Return name -> content of all members, directories left out. Raises BitstreamError.

    limit   bytes of all of them together
    """
    name = source.name
    try:
        archive = _opened(source)
        members = [info for info in archive.infolist() if not info.is_dir()]
        if len(members) > MAX_MEMBERS:
            raise BitstreamError(f"{name}: {len(members):,} files in the archive, {MAX_MEMBERS} at most are possible")
        if len({info.filename for info in members}) < len(members):
            raise BitstreamError(f"{name}: a file stands twice in the archive")
        found: dict[str, bytes] = {}
        for info in members:
            if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) or info.flag_bits & 1:
                raise BitstreamError(f"{name}: '{info.filename}' in it is encrypted, or packed in a way of its own")
            if info.file_size > limit:
                raise BitstreamError(f"{name}: '{info.filename}' unpacks to {info.file_size:,} bytes: too many")
            with archive.open(info) as file:
                content = file.read(info.file_size + 1)
            if len(content) != info.file_size:
                raise BitstreamError(f"{name}: '{info.filename}' is not as long as the archive says")
            limit -= len(content)
            found[info.filename] = content
    except (zipfile.BadZipFile, zlib.error, EOFError, ValueError, OverflowError, NotImplementedError, OSError) as error:
        raise BitstreamError(f"{name}: a damaged ZIP archive: {error}") from error
    return found
