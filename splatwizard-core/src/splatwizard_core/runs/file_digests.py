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


class FileDigests:
    """SHA-256 of files. One whose size, inode, and times of change of content and of inode are as before is not read.

    store   JSON file that remembers; None: nothing is remembered. One that cannot be read or written costs time only.
    """

    def __init__(self, store: Path | None) -> None:
        self._store = store
        self._known: dict[str, Any] = {}
        if store is not None:
            with contextlib.suppress(OSError, ValueError):
                known = json.loads(store.read_text())
                self._known = known if isinstance(known, dict) else {}

    def of(self, files: Iterable[Path]) -> dict[Path, str]:
        """Map file to SHA-256, hexadecimal. Raises SceneError for one that cannot be read."""
        found: dict[Path, str] = {}
        unread: list[Path] = []
        for file in dict.fromkeys(files):
            known = self._known.get(str(file.absolute()))
            if isinstance(known, list) and len(known) == 2 and known[0] == _stamp(file):
                found[file] = str(known[1])
            else:
                unread.append(file)
        if unread:
            found |= self._read(unread)
            self._remember()
        return found

    def _read(self, files: list[Path]) -> dict[Path, str]:
        def read(file: Path) -> tuple[Path, list[int], str]:
            stamp = _stamp(file)  # before it is read: what changes meanwhile does not count as known
            try:
                return file, stamp, file_sha256(file)
            except OSError as error:
                raise SceneError(f"{file}: cannot be read: {error.strerror}", path=str(file)) from error

        found = {}
        with (
            track("compare pictures", total=len(files), unit="pictures") as bar,
            ThreadPoolExecutor(max_workers=THREADS) as pool,
        ):
            for file, stamp, digest in pool.map(read, files):
                found[file] = digest
                if stamp and time.time() - max(stamp[1:3]) / 1e9 > SETTLED_SECONDS:
                    self._known[str(file.absolute())] = [stamp, digest]
                bar.advance()
        return found

    def _remember(self) -> None:
        if self._store is not None:
            with contextlib.suppress(OSError, SplatwizardError):
                self._store.parent.mkdir(parents=True, exist_ok=True)
                write_json(self._store, self._known)


def _stamp(file: Path) -> list[int]:
    """Return the facts that change when a file does: size, two times in ns, inode; empty if it cannot be asked."""
    try:
        facts = os.stat(file)
    except OSError:
        return []
    return [facts.st_size, facts.st_mtime_ns, facts.st_ctime_ns, facts.st_ino]
