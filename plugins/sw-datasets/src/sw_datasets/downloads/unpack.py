"""Archives from strangers: their scene folders, checked before anything is written, and whole or not there.

Zip and tar (plain, gzip, bzip2, xz). Refused in one line: members that lead out of the folder, links, devices,
encrypted or sparse members, equal names, and bombs: far more content than the archive's size can honestly hold.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import lzma
import shutil
import stat
import struct
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from splatwizard_core.api import track
from splatwizard_core.tooling import new_folder
from sw_datasets.downloads.download import byte_progress
from sw_datasets.errors import ArchiveError, FetchError
from sw_datasets.picture_names import is_inside
from sw_datasets.zip_methods import check_method

MAX_MEMBERS = 200_000
MAX_RATIO = 100  # bytes unpacked per byte of archive; pictures reach 1.1, COLMAP text models 5
GRACE_BYTES = 1 << 26  # a small archive of text may exceed the ratio
MAX_HEADER_BYTES = 1 << 16  # a tar's extended header (long names), which the standard library keeps as a dictionary
MAX_GLOBAL_BYTES = 1 << 12  # of its global headers together, which it copies for every member
MAX_EXTENSIONS = 8  # extended headers in a row, which it reads into one another
EXTENSIONS = (
    tarfile.XHDTYPE, tarfile.XGLTYPE, tarfile.SOLARIS_XHDTYPE, tarfile.GNUTYPE_LONGNAME, tarfile.GNUTYPE_LONGLINK,
)  # fmt: skip
BLOCK_BYTES = 1 << 20
JUNK = ("__MACOSX", ".DS_Store", "Thumbs.db")
"""What systems leave in archives; passed over."""

Files = dict[str, tuple[int, str]]
"""Unpacked files: path -> (bytes, SHA-256)."""


@dataclass(frozen=True)
class Member:
    """One entry of an archive: its path as parts, and its size as the archive states it.

    skipped     a folder, or what systems leave in archives: not unpacked, but counted
    """

    parts: tuple[str, ...]
    size: int
    skipped: bool = False


@dataclass
class Unpacked:
    """A folder that was unpacked: where it lies, and the files in it."""

    path: Path
    files: Files = field(default_factory=dict)


def unpack_scenes(
    archive: Path,
    home: Path,
    scenes: Mapping[str, Sequence[str]],
    needs: Sequence[str] = (),
) -> dict[str, Unpacked]:
    """Unpack the folders of some scenes into `home`; each appears there when it is complete.

    scenes  scene -> the names that its folder may have; it may lie anywhere in the archive
    needs   files and folders that tell a scene's folder from others of its name

    What is in the archive besides is passed over. Raises FetchError in one line; then nothing was written.
    """
    members = _members(archive)
    roots = {scene: _find_scene(archive, members, scene, names, needs) for scene, names in scenes.items()}
    return _extract(archive, members, {scene: (root, home / root[-1]) for scene, root in roots.items()})


def unpack_whole(archive: Path, target: Path) -> Unpacked:
    """Unpack everything into the new folder `target`. Raises FetchError in one line; then nothing was written."""
    return _extract(archive, _members(archive), {"": ((), target)})[""]


def _extract(
    archive: Path, members: list[Member], wanted: Mapping[str, tuple[tuple[str, ...], Path]]
) -> dict[str, Unpacked]:
    """wanted: name -> (folder in the archive, folder to make of it)."""
    taken = [m for m in members if any(m.parts[: len(root)] == root for root, _ in wanted.values())]
    total = sum(member.size for member in taken)
    first = next(iter(wanted.values()))[1]
    place = first.parent
    place.mkdir(parents=True, exist_ok=True)
    free = shutil.disk_usage(place).free
    if total > free:
        raise FetchError(
            f"not enough space in {place}: {archive.name} unpacks to {total / 1e9:.2f} GB, {free / 1e9:.2f} GB are free"
        )
    done = {name: Unpacked(target) for name, (_, target) in wanted.items()}
    with contextlib.ExitStack() as folders, byte_progress(f"unpack {archive.name}", total) as count:
        # Each folder gets its name when the block ends, after the last byte of all of them.
        temporary = {name: folders.enter_context(_new_folder(target)) for name, (_, target) in wanted.items()}
        with _damage_named(archive), _opened(archive) as contents:
            for member, stream in contents:
                if member.skipped:
                    continue
                for name, (root, _) in wanted.items():
                    if member.parts[: len(root)] == root:
                        inner = member.parts[len(root) :]
                        digest = _write(stream(), temporary[name].joinpath(*inner), member, archive, count)
                        done[name].files["/".join(inner)] = (member.size, digest)
    return done


@contextlib.contextmanager
def _new_folder(target: Path) -> Iterator[Path]:
    try:
        with new_folder(target) as folder:
            yield folder
    except FileExistsError as error:
        if error.filename != str(target):
            raise
        raise FetchError(f"{target} is there already: move it away to unpack it again") from error


def _write(stream: IO[bytes], target: Path, member: Member, archive: Path, count: Callable[[int], None]) -> str:
    """Copy exactly the bytes that the archive announced; returns their SHA-256."""
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        opened = target.open("xb")
    except (FileExistsError, NotADirectoryError) as error:
        raise ArchiveError(f"{archive}: '{'/'.join(member.parts)}' is a file and a folder at once; refused") from error
    sha = hashlib.sha256()
    left = member.size
    with stream, opened as file:
        while block := stream.read(min(BLOCK_BYTES, left + 1)):
            left -= len(block)
            if left < 0:
                break
            file.write(block)
            sha.update(block)
            count(len(block))
    if left:
        raise ArchiveError(f"{archive}: '{'/'.join(member.parts)}' is not as long as announced: the archive is damaged")
    return sha.hexdigest()


def _find_scene(
    archive: Path, members: list[Member], scene: str, names: Sequence[str], needs: Sequence[str]
) -> tuple[str, ...]:
    """The folder in the archive that is the scene: of one of the names, with all that it needs, the topmost."""
    inside: dict[tuple[str, ...], set[tuple[str, ...]]] = {}
    for member in members:
        for i, part in enumerate(member.parts[:-1]):
            if part in names:
                rest = member.parts[i + 1 :]
                inside.setdefault(member.parts[: i + 1], set()).update(rest[:n] for n in range(1, len(rest) + 1))
    wanted = [tuple(need.split("/")) for need in needs]
    found = [root for root, held in inside.items() if all(need in held for need in wanted)]
    if not found:
        what = f" with {', '.join(needs)}" if needs else ""
        raise ArchiveError(f"{archive}: holds no folder '{names[0]}'{what} (scene '{scene}')")
    top = min(map(len, found))
    topmost = [root for root in found if len(root) == top]
    if len(topmost) > 1:
        shown = " and ".join("/".join(root) for root in topmost[:2])
        raise ArchiveError(f"{archive}: {shown} could both be scene '{scene}'; unpack the right one by hand")
    return topmost[0]


def _members(archive: Path) -> list[Member]:
    """All files of the archive, checked. Raises FetchError for the first that must not be unpacked."""
    limit = MAX_RATIO * archive.stat().st_size + GRACE_BYTES
    members: list[Member] = []
    seen: set[tuple[str, ...]] = set()
    total = entries = 0
    label = f"check {archive.name}"  # of a compressed tar, this reads it all
    with _damage_named(archive), _opened(archive) as contents, track(label, unit="files") as bar:
        for member, _ in contents:
            bar.advance()
            entries += 1
            total += member.size
            if total > limit or entries > MAX_MEMBERS:
                raise ArchiveError(
                    f"{archive}: {entries:,} entries of {total:,} bytes so far, from an archive of "
                    f"{archive.stat().st_size:,}: a decompression bomb; refused"
                )
            if member.skipped:
                continue
            if member.parts in seen:
                raise ArchiveError(f"{archive}: '{'/'.join(member.parts)}' is in it twice; refused")
            seen.add(member.parts)
            members.append(member)
    if not members:
        raise ArchiveError(f"{archive}: holds no file")
    return members


Contents = Iterator[tuple[Member, Callable[[], IO[bytes]]]]


@contextlib.contextmanager
def _opened(archive: Path) -> Iterator[Contents]:
    """The files of an archive in its order, each with a function that opens it."""
    if zipfile.is_zipfile(archive):
        with zipfile.ZipFile(archive) as opened_zip:
            yield _zip_contents(archive, opened_zip)
    else:
        try:
            opened_tar = tarfile.open(archive, tarinfo=_bounded_headers())  # noqa: SIM115 (closed below)
        except tarfile.TarError as error:
            raise ArchiveError(
                f"{archive} is no zip or tar archive, or damaged ({error}): perhaps a web page in its place"
            ) from error
        with opened_tar:
            yield _tar_contents(archive, opened_tar)


def _zip_contents(archive: Path, opened: zipfile.ZipFile) -> Contents:
    for info in opened.infolist():
        kind = stat.S_IFMT(info.external_attr >> 16)
        if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
            raise ArchiveError(f"{archive}: {info.filename!r} is a link or a device; refused")
        if info.flag_bits & 1:
            raise ArchiveError(f"{archive}: {info.filename!r} is encrypted; refused")
        check_method(info)
        parts = _parts(archive, info.filename)
        member = Member(parts, info.file_size, info.is_dir() or _is_junk(parts))
        yield member, lambda info=info: opened.open(info)  # type: ignore[misc]


def _tar_contents(archive: Path, opened: tarfile.TarFile) -> Contents:
    for info in opened:
        if not (info.isreg() or info.isdir()) or info.issparse() or info.size < 0:
            raise ArchiveError(f"{archive}: {info.name!r} is a link, a device or a sparse file; refused")
        parts = _parts(archive, info.name)
        member = Member(parts, info.size, info.isdir() or _is_junk(parts))
        yield member, lambda info=info: _tar_stream(opened, info)  # type: ignore[misc]
        opened.members = []  # it would keep the headers of all


def _tar_stream(opened: tarfile.TarFile, info: tarfile.TarInfo) -> IO[bytes]:
    stream = opened.extractfile(info)
    assert stream is not None  # it is a regular file
    return stream


def _bounded_headers() -> type[tarfile.TarInfo]:
    """The headers of one archive, whose extensions fit in memory, whatever they claim."""
    in_a_row = all_global = 0

    class Bounded(tarfile.TarInfo):
        @classmethod
        def frombuf(cls, buf: bytes | bytearray, encoding: str, errors: str) -> Any:
            """One header block. Raises tarfile.ReadError for too long or many extensions, or a negative size."""
            nonlocal in_a_row, all_global
            info = super().frombuf(buf, encoding, errors)
            in_a_row = in_a_row + 1 if info.type in EXTENSIONS else 0
            all_global += info.size if info.type == tarfile.XGLTYPE else 0
            if info.size < 0 or (in_a_row and info.size > MAX_HEADER_BYTES):
                raise tarfile.ReadError(f"a header claims {info.size:,} bytes")
            if in_a_row > MAX_EXTENSIONS or all_global > MAX_GLOBAL_BYTES:
                raise tarfile.ReadError(f"{in_a_row} extended headers in a row, {all_global:,} bytes of global ones")
            return info

    return Bounded


def _parts(archive: Path, name: str) -> tuple[str, ...]:
    """A member's path; () of the folder itself, which `tar -C FOLDER .` puts first.

    Raises FetchError if it leads out of the folder it is unpacked to.
    """
    if name and set(name.split("/")) <= {"", "."} and not name.startswith("/"):
        return ()
    if not is_inside(name) or ":" in name.split("/")[0] or not name.isprintable():
        raise ArchiveError(f"{archive}: {name!r} leads out of the folder or cannot be a file name; refused")
    return tuple(part for part in name.split("/") if part not in ("", "."))


def _is_junk(parts: tuple[str, ...]) -> bool:
    return not parts or parts[0] in JUNK or parts[-1] in JUNK


@contextlib.contextmanager
def _damage_named(archive: Path) -> Iterator[None]:
    """Turn what decoders raise on damage into an ArchiveError; a full disk stays what it is."""
    try:
        yield
    except (zipfile.BadZipFile, tarfile.TarError, zlib.error, lzma.LZMAError, EOFError, struct.error) as error:
        raise ArchiveError(f"{archive}: damaged or incomplete ({error})") from error
    except (NotImplementedError, RuntimeError, ValueError, OverflowError) as error:
        raise ArchiveError(f"{archive}: cannot be unpacked ({error})") from error
    except OSError as error:
        # gzip and bzip2 report damage without a number; a zip may name a place before its start.
        if error.errno in (None, errno.EINVAL):
            raise ArchiveError(f"{archive}: damaged or incomplete ({error})") from error
        raise
