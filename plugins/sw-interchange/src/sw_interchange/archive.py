"""Members of ZIP archives from strangers, each bounded before it is decompressed."""

from __future__ import annotations

import io
import zipfile

from splatwizard_core.api import BitstreamError
from sw_interchange.source import Source

MAX_MEMBERS = 64


def entries_of(source: Source) -> list[zipfile.ZipInfo]:
    """Entries of the central directory. Raises BitstreamError."""
    return _opened(source).infolist()


def is_one_ply(names: list[str]) -> bool:
    """Whether an archive of these files holds one .ply and no pictures."""
    return sum(name.lower().endswith(".ply") for name in names) == 1 and not any(
        name.lower().endswith(".webp") for name in names
    )


def read_entry(source: Source, info: zipfile.ZipInfo) -> bytes:
    """Return the content of one entry, no more bytes than it claims. Raises BitstreamError."""
    try:
        with _opened(source).open(info) as file:
            return file.read(info.file_size)
    except BitstreamError:
        raise
    except Exception as error:  # as below
        raise _damaged(source, error) from error


def _opened(source: Source) -> zipfile.ZipFile:
    try:
        return zipfile.ZipFile(_View(source.data))
    except Exception as error:  # zipfile raises many kinds for damaged archives, struct.error among them
        raise _damaged(source, error) from error


def _damaged(source: Source, error: Exception) -> BitstreamError:
    reason = " ".join(str(error).split())[:200] or type(error).__name__
    return BitstreamError(f"{source.name}: a damaged ZIP archive: {reason}")


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
    name, archive = source.name, _opened(source)
    try:
        members = [info for info in archive.infolist() if not info.filename.endswith("/")]
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
    except BitstreamError:
        raise
    except Exception as error:  # as above
        raise _damaged(source, error) from error
    return found
