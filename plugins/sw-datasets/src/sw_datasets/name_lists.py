"""Splits by lists of names: a file of names, or JSON with "train" and "test", of the user or beside the scene."""

from __future__ import annotations

import hashlib
import json
import os
import stat
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from splatwizard_core.api import SceneError, View
from splatwizard_core.tooling import json_reason
from sw_datasets.picture_names import name_key

LARGEST = 16 << 20  # bytes of a list
KEYS = {
    "train": "train", "test": "test", "train_filenames": "train", "test_filenames": "test", "train_names": "train",
    "test_names": "test",
}  # fmt: skip
BESIDE = ("", "sparse/0", "sparse")
"""Folders of a scene in which train.txt and test.txt are looked for: its own, and that of the model (3DGS code)."""


@dataclass(frozen=True)
class NameLists:
    """Names of the views to train and to test, None where a list is not given, and where they come from."""

    train: tuple[str, ...] | None
    test: tuple[str, ...] | None
    source: str


def lists_beside(scene: Path) -> NameLists | None:
    """The lists train.txt and test.txt (or one of them) of a scene folder; None without them."""
    for place in BESIDE:
        found = {part: scene / place / f"{part}.txt" for part in ("train", "test")}
        there = {part: _names_of(file) for part, file in found.items() if os.path.isfile(file)}
        if there:
            told = " and ".join(f"{place}/{part}.txt".lstrip("/") for part in there)
            return NameLists(there.get("train"), there.get("test"), told)
    return None


def read_lists(path: Path) -> NameLists:
    """The lists of a file: names of test views, one a line (of training views if it is called train...), or JSON.

    JSON is an object with "train" and "test", or one of them, or a list of the names of test views.
    Raises SceneError.
    """
    text = _text_of(path)
    if text.lstrip()[:1] not in ("{", "["):
        names = _lines(text)
        is_train = path.name.lower().startswith("train")
        return NameLists(names if is_train else None, None if is_train else names, path.name)
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise SceneError(f"{path}: not readable JSON ({json_reason(error)})", path=str(path)) from error
    if isinstance(content, list):
        content = {"test": content}
    parts: dict[str, tuple[str, ...]] = {}
    for key, part in KEYS.items():
        names = content.get(key)
        if names is None:
            continue
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise SceneError(f"{path}: '{key}' must be a list of names of pictures", path=str(path))
        parts[part] = tuple(names)
    if not parts:
        raise SceneError(f"{path}: neither 'train' nor 'test' is a list of names in it", path=str(path))
    return NameLists(parts.get("train"), parts.get("test"), path.name)


def split_by_lists(views: Sequence[View], lists: NameLists) -> tuple[list[View], list[View], list[str]]:
    """(train, test, warnings): views by the lists, in the views' order; of one list alone, the other half is the rest.

    Names may lack folder or suffix where it is clear which view is meant. Views in neither of two lists are left out,
    names without a view are passed over, and both are told. Raises SceneError for a name that is in both lists or
    could be two views, and for a half without a view.
    """
    find = _finder(views, lists.source)
    chosen: dict[str, set[str]] = {}
    absent: list[str] = []
    for part, names in (("train", lists.train), ("test", lists.test)):
        if names is not None:
            found = [(name, find(name)) for name in names]
            absent += [name for name, view in found if view is None]
            chosen[part] = {view for _, view in found if view is not None}
    if both := sorted(chosen.get("train", set()) & chosen.get("test", set())):
        raise SceneError(f"{lists.source}: '{both[0]}' is to be trained and tested ({len(both)} of this kind)")
    everything = {view.name for view in views}
    train = chosen["train"] if "train" in chosen else everything - chosen["test"]
    test = chosen["test"] if "test" in chosen else everything - train
    if not train or not test:
        first = f"; no view is called {absent[0]!r:.80}" if absent else ""
        raise SceneError(
            f"{lists.source}: of {len(views)} views it gives {len(train)} to train and {len(test)} to test, both need "
            f"1{first}"
        )
    warnings = [f"split by {lists.source}: {len(train)} views to train, {len(test)} to test"]
    if absent:
        warnings.append(f"{len(absent)} names in {lists.source} are of no view, the first: {absent[0]!r:.80}")
    if left := len(everything) - len(train | test):
        warnings.append(f"{left} views are in none of the lists of {lists.source} and are left out")
    return [v for v in views if v.name in train], [v for v in views if v.name in test], warnings


def lists_id(train: Sequence[View], test: Sequence[View]) -> str:
    """Return the part of a protocol id for such a split: a hash of the names in either half, whatever their file."""
    content = [sorted(name_key(view.name) for view in part) for part in (train, test)]
    return f"names-{hashlib.sha256(json.dumps(content).encode()).hexdigest()[:12]}"


def _finder(views: Sequence[View], source: str) -> Callable[[str], str | None]:
    """name -> the view's name; None for a name of no view."""
    ways: tuple[Callable[[str], str], ...] = (
        name_key,
        lambda name: os.path.splitext(name_key(name))[0],
        lambda name: name_key(name).rpartition("/")[2],
        lambda name: os.path.splitext(name_key(name).rpartition("/")[2])[0],
    )
    tables: list[dict[str, list[str]]] = [{} for _ in ways]
    for view in views:
        for way, table in zip(ways, tables, strict=True):
            table.setdefault(way(view.name), []).append(view.name)

    def find(name: str) -> str | None:
        for way, table in zip(ways, tables, strict=True):
            found = table.get(way(name), [])
            if len(found) > 1:
                raise SceneError(f"{source}: {name!r:.80} could be {' or '.join(found[:3])}: give the folder too")
            if found:
                return found[0]
        return None

    return find


def _names_of(path: Path) -> tuple[str, ...]:
    return _lines(_text_of(path))


def _lines(text: str) -> tuple[str, ...]:
    lines = (line.strip() for line in text.splitlines())
    return tuple(line for line in lines if line and not line.startswith("#"))


def _text_of(path: Path) -> str:
    try:
        told = os.stat(path)  # before it is opened: opening a pipe waits for a writer
        if not stat.S_ISREG(told.st_mode) or told.st_size > LARGEST:
            raise SceneError(f"{path}: no list of names: it is no file, or larger than {LARGEST:,} bytes")
        return path.read_bytes().decode("utf-8-sig")
    except (OSError, ValueError) as error:
        raise SceneError(f"{path}: the list of names cannot be read ({error})", path=str(path)) from error
