"""Files that are either whole or not there: written beside their place and then renamed into it."""

from __future__ import annotations

import contextlib
import errno
import functools
import hashlib
import json
import os
import re
import secrets
import shutil
import socket
import tempfile
import time
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from splatwizard_core.errors import FULL, DiskFullError

TEMPORARY = r"\.(\d+)-(?:([0-9a-f]{8})-)?[0-9a-f]{8}\.tmp"
"""The end of a temporary file's name, after `.NAME`: the process that writes it, where its number holds (`_numbering`;
0.1 did not say), and a random part."""

FOREIGN_SECONDS = 86_400.0
"""Silence after which the temporary of another container or machine counts as left behind."""
YOUNGER_SECONDS = 2.0
"""By how much a process must be younger than a file to be another one of the same number: clocks count in seconds."""

LARGEST_DESCRIPTION = 1 << 20
"""Bytes of a file that is looked into for the names of others; a larger one is all of its scene."""


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str], *, wanted: int | None = None, durable: bool = False) -> Iterator[Path]:
    """A path beside `path` to write to; when the block ends, that file takes the place of `path`.

    wanted      bytes that will be written, if known, for the message
    durable     on the disk itself before it takes its place: it holds after a power failure too

    If the block raises, `path` holds what it held before and the temporary file is gone. What killed processes left of
    earlier writes to `path` is removed. Raises DiskFullError; other errors of the system (OSError) pass through.
    """
    path = Path(path)
    temporary = _temporary(path)
    try:
        with naming_full_disk(path, wanted):
            yield temporary
            if durable:
                with temporary.open("rb") as file:
                    os.fsync(file.fileno())
            os.replace(temporary, path)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise


@contextlib.contextmanager
def naming_full_disk(path: str | os.PathLike[str], wanted: int | None = None) -> Iterator[None]:
    """Turn what the system, or a library in another language, says of a full disk into DiskFullError.

    wanted      bytes that the block writes, if known
    """
    try:
        yield
    except Exception as error:
        told = re.search(r"\(os error (\d+)\)", str(error))  # how libraries written in Rust pass it on
        code = error.errno if isinstance(error, OSError) else int(told[1]) if told is not None else None
        if code not in FULL:
            raise
        free = None
        if code == errno.ENOSPC:
            with contextlib.suppress(OSError):
                free = shutil.disk_usage(Path(path).parent).free
        raise DiskFullError(str(path), FULL[code], wanted, free) from error


@contextlib.contextmanager
def new_folder(path: str | os.PathLike[str]) -> Iterator[Path]:
    """An empty folder beside `path` to fill; when the block ends, it is renamed to `path`.

    If the block raises, `path` is not there and what was written is gone. What killed processes left of earlier tries
    is removed. Raises FileExistsError if `path` holds something; other errors of the system pass through.
    """
    path = Path(path)
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise FileExistsError(errno.EEXIST, "is there already and not empty", str(path))
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = _temporary(path)
    temporary.mkdir()
    try:
        with naming_full_disk(path):
            yield temporary
        os.rename(temporary, path)  # also over an empty folder, never over one that holds something
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def write_atomic(path: str | os.PathLike[str], content: str | bytes) -> None:
    """Write text (UTF-8) or bytes so that `path` holds what it held before or all of it, also after a crash."""
    data = content.encode() if isinstance(content, str) else content
    with replacing(path, wanted=len(data), durable=True) as temporary:
        temporary.write_bytes(data)


def write_json(path: str | os.PathLike[str], content: Any) -> None:
    """`write_atomic` of JSON; raises ValueError for a number that is not finite."""
    write_atomic(path, json.dumps(content, indent=2, allow_nan=False) + "\n")


def file_sha256(path: Path) -> str:
    """SHA-256 of a file's bytes, hexadecimal."""
    sha = hashlib.sha256()
    with path.open("rb") as file:
        for block in iter(lambda: file.read(1 << 20), b""):
            sha.update(block)
    return sha.hexdigest()


def bytes_with_named(path: Path) -> int:
    """Bytes of a file; of a .json or .gltf, which may describe images or buffers, those that it names too.

    Only files in its own folder or below count, each once, and what a .json among them names. Raises OSError.
    """
    sizes, waiting = {path: path.stat().st_size}, [path]
    while waiting:
        file = waiting.pop()
        if file.suffix.lower() not in (".json", ".gltf") or sizes[file] > LARGEST_DESCRIPTION:
            continue
        for name in re.findall(r'"([^"\\]{1,128})"', file.read_text("utf-8", errors="replace")):
            named, inside = file.parent / name, not name.startswith("/") and ".." not in name.split("/")
            if inside and named not in sizes and os.path.isfile(named):  # no error for a name too long
                sizes[named] = named.stat().st_size
                waiting.append(named)
    return sum(sizes.values())


@contextlib.contextmanager
def scratch_folder(purpose: str) -> Iterator[Path]:
    """An empty folder among the system's temporary files, removed when the block ends.

    Those of the same purpose that killed processes left are removed too.
    """
    folder = _temporary(Path(tempfile.gettempdir()) / f"splatwizard-{purpose}")
    with naming_full_disk(folder):
        folder.mkdir(mode=0o700)
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)


def remove_folder(path: Path) -> None:
    """Remove a folder so that at no moment a part of it stands in its place."""
    away = _temporary(path)
    os.replace(path, away)
    shutil.rmtree(away)


def sweep(folder: Path, name: str | None = None) -> None:
    """Remove the temporaries directly in `folder` that killed processes left; others may be writing there.

    name    what they were to become; None: anything
    """
    pattern = re.compile(rf"\.{'.+' if name is None else re.escape(name)}{TEMPORARY}")
    with contextlib.suppress(OSError):
        for match in filter(None, map(pattern.fullmatch, os.listdir(folder))):
            left = folder / match[0]
            if match[2] in (None, _numbering()):
                if _is_writing(int(match[1]), left):
                    continue
            elif time.time() - left.lstat().st_mtime < FOREIGN_SECONDS:
                continue
            if left.is_dir() and not left.is_symlink():
                shutil.rmtree(left, ignore_errors=True)
            else:
                left.unlink(missing_ok=True)


def _temporary(path: Path) -> Path:
    """A new name beside `path`, as `TEMPORARY` describes it, in place of those that killed processes left."""
    sweep(path.parent, path.name)
    return path.with_name(f".{path.name}.{os.getpid()}-{_numbering()}-{secrets.token_hex(4)}.tmp")


@functools.cache
def _numbering() -> str:
    """8 hexadecimal digits of where the numbers of processes hold: a container, or a machine since it started."""
    try:
        where = Path("/proc/sys/kernel/random/boot_id").read_text() + os.readlink("/proc/self/ns/pid")
    except OSError:
        where = socket.gethostname()
    return f"{zlib.crc32(where.encode()):08x}"


def _is_writing(process: int, file: Path) -> bool:
    """Whether the process of this number, if there is one, can be the one that began `file`.

    Numbers come back, in containers at once: a process that is younger than the file is another one.
    """
    import psutil

    try:
        began: float = psutil.Process(process).create_time()
        return began - YOUNGER_SECONDS < file.stat().st_mtime
    except (psutil.NoSuchProcess, FileNotFoundError, OverflowError, ValueError):
        return False
    except (psutil.Error, OSError):
        return True
