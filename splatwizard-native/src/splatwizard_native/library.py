"""A compiled library on disk, and the facts that its build writes beside it."""

from __future__ import annotations

import hashlib
import json
import logging
import os
from pathlib import Path
from typing import Any

from splatwizard_native.waiting import watch_cores

log = logging.getLogger(__name__)


def install(built: Path, library: Path, facts: dict[str, Any]) -> None:
    """Move a new library into its place, then its digest and `facts`; `built` is on the same file system."""
    written = built.with_suffix(".json")
    written.write_text(json.dumps({"sha256": _sha256(built), **facts}, indent=2) + "\n", encoding="utf-8")
    os.replace(built, library)
    os.replace(written, library.with_suffix(".json"))


def is_intact(library: Path) -> bool:
    """Whether the file is the one that the build wrote, and nobody else's.

    A truncated library may load and crash the process later; one of another user may do anything.
    """
    try:
        # Whoever installed this code may bring libraries too.
        trusted = {os.getuid(), 0, os.stat(__file__).st_uid} if hasattr(os, "getuid") else {os.stat(library).st_uid}
        if (owner := os.stat(library).st_uid) not in trusted:
            log.warning("%s belongs to another user (%s): it is not loaded, but compiled anew", library, owner)
            return False
        return _facts(library).get("sha256") == _sha256(library)
    except OSError:
        return False


def architectures_of(library: Path | None) -> list[str]:
    """Compute capabilities that the library's CUDA kernels are compiled for; empty if it has none."""
    return [] if library is None else _facts(library).get("architectures") or []


def load_ops(library: Path) -> str | None:
    """Load the ops into torch; the reason if that fails."""
    import torch

    try:
        torch.ops.load_library(str(library))  # type: ignore[no-untyped-call]
    except (OSError, RuntimeError) as error:
        return str(error.__cause__ or error)
    watch_cores()
    return None


def _facts(library: Path) -> dict[str, Any]:
    """Facts that the build wrote beside a library; empty if they cannot be read."""
    try:
        facts = json.loads(library.with_suffix(".json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return facts if isinstance(facts, dict) else {}


def _sha256(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()
