"""Checksum of the content of a scene, for keys of cached and finished work."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import torch
from torch import Tensor

from splatwizard_core.base.files import file_sha256
from splatwizard_core.base.progress import track
from splatwizard_core.errors import SceneError
from splatwizard_core.scene.scene import Scene, View

SAMPLED_PICTURES = 8
THREADS = 4  # hashing lets go of the interpreter; more than a disk can feed are of no use


def scene_digest(scene: Scene) -> str:
    """Return the SHA-256 over protocol, view names, cameras, start points, and what every picture and mask file holds.

    Where the pictures come from no file that can be told (`picture_files`), their pixels count instead: all of them, or
    if the scene lies nowhere, since then it is drawn, and drawn alike each time, those of eight training views.
    """
    sha = hashlib.sha256(f"{scene.name}\n{scene.protocol.id}\n".encode())

    def add(tensor: Tensor) -> None:
        sha.update(f"{tuple(tensor.shape)}{tensor.dtype}".encode())
        sha.update(tensor.detach().cpu().contiguous().view(-1).view(torch.uint8).numpy().tobytes())

    files = {view: picture_files(view) for view in (*scene.train, *scene.test)}
    contents = digests_of(file for found in files.values() for file in found)
    count = min(SAMPLED_PICTURES, len(scene.train))
    sampled = {scene.train[i * len(scene.train) // count] for i in range(count)} if scene.path is None else set(files)
    for part in (scene.train, scene.test):
        sha.update(f"{len(part)} views\n".encode())
        for view in part:
            c = view.camera
            sha.update(f"{view.name}\n{c.width} {c.height} {c.fx!r} {c.fy!r} {c.cx!r} {c.cy!r}\n".encode())
            add(c.R)
            add(c.tau)
            for file in files[view]:
                sha.update(contents[file].encode())
            if not files[view] and view.load is not None and view in sampled:
                add(view.pixels)
    if scene.points is not None:
        add(scene.points.xyz)
        if scene.points.rgb is not None:
            add(scene.points.rgb)
    return sha.hexdigest()


def digests_of(files: Iterable[Path]) -> dict[Path, str]:
    """Map file to SHA-256, hexadecimal. Raises SceneError for one that cannot be read."""
    wanted, found = list(dict.fromkeys(files)), dict[Path, str]()
    with (
        track("compare pictures", total=len(wanted), unit="pictures") as bar,
        ThreadPoolExecutor(max_workers=THREADS) as pool,
    ):
        for file, digest in zip(wanted, pool.map(_digest, wanted), strict=True):
            found[file] = digest
            bar.advance()
    return found


def _digest(file: Path) -> str:
    try:
        return file_sha256(file)
    except OSError as error:
        raise SceneError(f"{file}: cannot be read: {error.strerror}", path=str(file)) from error


def picture_files(view: View) -> list[Path]:
    """List the files that a view's picture and mask are read from; empty if that cannot be told.

    A loader tells by making `View.load` and `View.load_mask` a `functools.partial` of a function that takes the paths
    of all its files as positional arguments.
    """
    found: list[Path] = []
    for load in (view.load, view.load_mask):
        if load is None:
            continue
        paths = [a for a in load.args if isinstance(a, Path)] if isinstance(load, functools.partial) else []
        if not paths:
            return []
        found += paths
    return found
