"""Checksums of files, remembered between runs: reading thousands of pictures takes long."""

from __future__ import annotations

import contextlib
import json
import os
import time
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from splatwizard_core.errors import SceneError, SplatwizardError
from splatwizard_core.files import file_sha256, write_json
from splatwizard_core.progress import track

SETTLED_SECONDS = 2.0  # a file that changed just now may change again within one tick of its clock
THREADS = 4  # hashing lets go of the interpreter; more than a disk can feed are of no use


def digests_of(files: Iterable[Path], store: Path | None = None) -> dict[Path, str]:
    """Map file to SHA-256, hexadecimal. Raises SceneError for one that cannot be read.

    store   JSON file that remembers; None: nothing is remembered. One that cannot be read or written costs time only.

    A file whose size, inode, and times of change of content and of inode are as before is not read.
    """
    known = _remembered(store)
    stamps = {file: _stamp(file) for file in files}  # before they are read: what changes meanwhile is not known then
    found: dict[Path, str] = {}
    for file, stamp in stamps.items():
        entry = known.get(str(file.absolute()))
        if isinstance(entry, list) and len(entry) == 2 and entry[0] == stamp:
            found[file] = str(entry[1])
    unread = [file for file in stamps if file not in found]
    if not unread:
        return found
    with (
        track("compare pictures", total=len(unread), unit="pictures") as bar,
        ThreadPoolExecutor(max_workers=THREADS) as pool,
    ):
        for file, digest in zip(unread, pool.map(_read, unread), strict=True):
            found[file], stamp = digest, stamps[file]
            if stamp and time.time() - max(stamp[1:3]) / 1e9 > SETTLED_SECONDS:
                known[str(file.absolute())] = [stamp, digest]
            bar.advance()
    if store is not None:
        with contextlib.suppress(OSError, SplatwizardError):
            store.parent.mkdir(parents=True, exist_ok=True)
            write_json(store, known)
    return found


def _remembered(store: Path | None) -> dict[str, Any]:
    with contextlib.suppress(OSError, ValueError):
        known = json.loads(store.read_text()) if store is not None else {}
        return known if isinstance(known, dict) else {}
    return {}


def _read(file: Path) -> str:
    try:
        return file_sha256(file)
    except OSError as error:
        raise SceneError(f"{file}: cannot be read: {error.strerror}", path=str(file)) from error


def _stamp(file: Path) -> list[int]:
    """Return the facts that change when a file does: size, two times in ns, inode; empty if it cannot be asked."""
    try:
        facts = os.stat(file)
    except OSError:
        return []
    return [facts.st_size, facts.st_mtime_ns, facts.st_ctime_ns, facts.st_ino]
