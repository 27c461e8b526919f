"""Where a scene is: a path as it stands, or `dataset/scene` below $SPLATWIZARD_DATA."""

from __future__ import annotations

import difflib
import os
from collections.abc import Sequence
from pathlib import Path

from sw_datasets.downloads.presence import DATA_VARIABLE
from sw_datasets.families import BENCHMARKS

from splatwizard_core.errors import SceneError


def locate(spec: str) -> tuple[Path, str | None]:
    """(folder, the dataset it was asked for under, None for a path).

    `mipnerf360/garden` is $SPLATWIZARD_DATA/mipnerf360/garden, or lies in a folder that the collection is known by
    (`360_v2`); `dtu/24` is also `dtu/scan24`.

    Raises SceneError that says what there is instead, and which of it is spelt most alike.
    """
    path = Path(os.path.expanduser(spec))
    if os.path.exists(path):
        return path, None
    if path.is_absolute() or spec.startswith("~"):
        raise _missing(spec, ": give a scene folder, dataset/scene, or demo")
    named = os.environ.get(DATA_VARIABLE)
    if not named:
        raise _missing(
            spec,
            ": give a scene folder, dataset/scene, or demo "
            f"(${DATA_VARIABLE} is not set, so dataset/scene names are not looked up)",
        )
    root = Path(os.path.expanduser(named))
    if not os.path.isdir(root):
        raise _missing(spec, f", and ${DATA_VARIABLE} names no folder: {root}")
    parts = path.parts
    if os.path.exists(root / path):
        return root / path, parts[0] if len(parts) == 2 else None
    if len(parts) == 2:
        for candidate in _published_places(root, *parts):
            if os.path.exists(candidate):
                return candidate, parts[0]
    raise _missing(spec, _what_is_there(root, parts))


def _missing(spec: str, rest: str) -> SceneError:
    return SceneError(f"scene '{spec}' is not there{rest}", path=spec)


def _published_places(root: Path, dataset: str, scene: str) -> list[Path]:
    family = BENCHMARKS.get(dataset)
    if family is None:
        return []
    homes = [root / name for name in _folders(root) if family.is_home(name)]
    names = dict.fromkeys((scene, family.prefix + scene))
    return [home / name for home in homes for name in names]


def _what_is_there(root: Path, parts: Sequence[str]) -> str:
    """The rest of the message: how far the name leads, and what could be meant."""
    datasets = _folders(root)
    if len(parts) == 1:
        holders = [name for name in datasets if os.path.isdir(root / name / parts[0])]
        if holders:
            return f": did you mean {holders[0]}/{parts[0]} (below ${DATA_VARIABLE})?"
        return f", nor is {root / parts[0]}: datasets are named as dataset/scene; {_listed(root, datasets, parts[0])}"
    family = BENCHMARKS.get(parts[0])
    homes = [n for n in datasets if n == parts[0] or (family is not None and family.is_home(n))]
    if not homes:
        return f", nor is {root / Path(*parts)}: {_listed(root, datasets, parts[0])}"
    home = root / homes[0]
    return f", nor is {home / Path(*parts[1:])}: {_listed(home, _folders(home), parts[1])}"


def _listed(folder: Path, names: Sequence[str], wanted: str) -> str:
    if not names:
        return f"there is no folder in {folder}"
    near = difflib.get_close_matches(wanted, names, n=1)
    shown = ", ".join(names[:20]) + (", ..." if len(names) > 20 else "")
    return (f"did you mean '{near[0]}'? " if near else "") + f"In {folder}: {shown}"


def _folders(path: Path) -> list[str]:
    """Sorted names of the folders in `path`; empty where it cannot be listed."""
    try:
        with os.scandir(path) as entries:
            return sorted(entry.name for entry in entries if entry.is_dir() and not entry.name.startswith("."))
    except OSError:
        return []
