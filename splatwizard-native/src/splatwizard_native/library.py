"""A compiled library on disk, and the facts that its build writes beside it."""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import json
import logging
import os
import shutil
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from splatwizard_native.face import ABI
from splatwizard_native.waiting import watch_cores

log = logging.getLogger(__name__)

KEPT_SECONDS = 7 * 86_400.0


def install(built: Path, library: Path, facts: dict[str, Any]) -> None:
    """Move a new library into its place, then its digest and `facts`; `built` is on the same file system."""
    written = built.with_suffix(".json")
    written.write_text(json.dumps({"sha256": _sha256(built), **facts}, indent=2) + "\n", encoding="utf-8")
    os.replace(built, library)
    os.replace(written, library.with_suffix(".json"))


def fetch(kept: Path, output: Path) -> bool:
    """Copy an object of an earlier build to `output`, and say whether there was one."""
    with contextlib.suppress(OSError):
        if _is_trusted(kept):
            shutil.copyfile(kept, output)
            os.utime(kept)
            return True
    return False


def keep(output: Path, kept: Path) -> None:
    """Keep an object for later builds, if there is space, and forget those of the folder that none used for a while."""
    with contextlib.suppress(OSError):
        kept.parent.mkdir(exist_ok=True)
        beside = kept.with_name(f".{kept.name}.{os.getpid()}")
        shutil.copyfile(output, beside)
        os.replace(beside, kept)
        for other in kept.parent.iterdir():
            if other.stat().st_mtime < time.time() - KEPT_SECONDS:
                other.unlink()


def is_intact(library: Path) -> bool:
    """Whether the file is the one that the build wrote, and nobody else's.

    A truncated library may load and crash the process later; one of another user may do anything.
    """
    try:
        return _is_trusted(library) and _facts(library).get("sha256") == _sha256(library)
    except OSError:
        return False


def _is_trusted(file: Path) -> bool:
    # Whoever installed this code may bring libraries too.
    trusted = {os.getuid(), 0, os.stat(__file__).st_uid} if hasattr(os, "getuid") else {os.stat(file).st_uid}
    if (owner := os.stat(file).st_uid) not in trusted:
        log.warning("%s belongs to another user (%s): it is not loaded, but compiled anew", file, owner)
        return False
    return True


def architectures_of(library: Path | None) -> list[str]:
    """Compute capabilities that the library's CUDA kernels are compiled for; empty if it has none."""
    return [] if library is None else _facts(library).get("architectures") or []


def open_face(library: Path, name: str, source_hash: str, symbols: Iterable[str]) -> ctypes.CDLL:
    """Open a library. Raises OSError if it has no plain C face, or is one of other sources."""
    opened = ctypes.CDLL(str(library))
    try:
        abi, told = getattr(opened, f"{name}_abi")(), getattr(opened, f"{name}_hash")
        getattr(opened, f"{name}_last_error").restype = told.restype = ctypes.c_char_p
        for symbol in symbols:
            getattr(opened, symbol)
    except AttributeError as error:
        raise OSError(str(error)) from error
    if (abi, told()) != (ABI, source_hash.encode()):
        raise OSError(f"it is of ABI {abi} and sources {told().decode()}, not {ABI} and {source_hash}")
    watch_cores()
    return opened


def _facts(library: Path) -> dict[str, Any]:
    """Facts that the build wrote beside a library; empty if they cannot be read."""
    try:
        facts = json.loads(library.with_suffix(".json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return facts if isinstance(facts, dict) else {}


def _sha256(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()
