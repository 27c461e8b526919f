"""Disk cache of rendered pictures: the demo scene is rendered once per machine, not once per run."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import math
import platform
import stat
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from splatwizard_core.api import Camera, replacing
from splatwizard_core.tooling import DiskFullError
from splatwizard_native import cache_root

FOLDER = "demo-pictures"
"""Below the folder of this user's caches; may be deleted at any time."""
MAX_BYTES = 64 << 20
"""All kept pictures together: `demo` takes 11 MB, `demo:tiny` 75 kB. The oldest make room for new ones."""
DIGEST_BYTES = 32


def kept_or_drawn(key: str, shape: tuple[int, int, int], draw: Callable[[], NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Return a picture of `shape` [H,W,3], uint8: the one kept under `key`, else drawn, and kept for the next time.

    A kept file that is damaged, or anything else in its place, is drawn anew; several processes may do so at once.
    Without a folder to write to, every picture is drawn.
    """
    file = cache_root() / FOLDER / key
    found = _read(file, shape)
    if found is None:
        found = draw()
        with contextlib.suppress(OSError, DiskFullError):
            _keep(file, np.ascontiguousarray(found).tobytes())
    return found


def picture_key(world: bytes, camera: Camera, samples: int, background: float) -> str:
    """Name of a picture: SHA-256, hexadecimal, of all that its pixels depend on.

    world   what the solids were made from
    """
    sha = hashlib.sha256(_drawn_by())
    sha.update(hashlib.sha256(world).digest())
    for tensor in (camera.R, camera.tau):
        sha.update(tensor.double().cpu().contiguous().numpy().tobytes())
    c = camera
    sha.update(f"{(c.width, c.height, c.fx, c.fy, c.cx, c.cy, samples, background)!r}".encode())
    return sha.hexdigest()


@functools.cache
def _drawn_by() -> bytes:
    """Digest of the code that draws: this package's sources, and what may round otherwise in another version."""
    sha = hashlib.sha256(f"{np.__version__} {torch.__version__} {platform.machine()}\n".encode())
    for source in sorted(files(__package__).iterdir(), key=lambda path: path.name):
        if source.name.endswith(".py"):
            sha.update(source.name.encode() + b"\n" + hashlib.sha256(source.read_bytes()).digest())
    return sha.digest()


def _read(file: Path, shape: tuple[int, int, int]) -> NDArray[np.uint8] | None:
    """Read a kept picture; None if it is not there, or not what was written."""
    try:
        status = file.lstat()
        if not stat.S_ISREG(status.st_mode) or status.st_size != DIGEST_BYTES + math.prod(shape):
            return None
        content = file.read_bytes()
    except OSError:
        return None
    if hashlib.sha256(content[DIGEST_BYTES:]).digest() != content[:DIGEST_BYTES]:
        return None
    return np.frombuffer(content, np.uint8, offset=DIGEST_BYTES).reshape(shape).copy()


def _keep(file: Path, pixels: bytes) -> None:
    """Write a picture behind its digest, if it fits; raises OSError or DiskFullError."""
    room = MAX_BYTES - DIGEST_BYTES - len(pixels)
    if room < 0:
        return
    file.parent.mkdir(parents=True, exist_ok=True)
    _make_room(file.parent, room)
    with replacing(file) as temporary:
        temporary.write_bytes(hashlib.sha256(pixels).digest() + pixels)


def _make_room(folder: Path, most: int) -> None:
    """Remove the oldest files until those of the folder have at most `most` bytes."""
    kept = []
    for path in folder.iterdir():
        with contextlib.suppress(OSError):  # another process made room meanwhile
            status = path.lstat()
            if stat.S_ISREG(status.st_mode):
                kept.append((status.st_mtime_ns, status.st_size, path))
    total = sum(size for _, size, _ in kept)
    for _, size, path in sorted(kept):
        if total <= most:
            break
        with contextlib.suppress(OSError):
            path.unlink()
        total -= size
