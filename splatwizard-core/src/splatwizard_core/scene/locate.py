"""Finds the folder of a scene: a path as it stands, or `dataset/scene` below $SPLATWIZARD_DATA."""

from __future__ import annotations

import difflib
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from splatwizard_core.errors import SceneError

if TYPE_CHECKING:
    from typing import TypeAlias

    from splatwizard_core.plugins.registry import TypedRegistry
    from splatwizard_core.scene.dataset import Dataset

    Families: TypeAlias = TypedRegistry[type[Dataset] | Dataset]

DATA_VARIABLE = "SPLATWIZARD_DATA"
"""Names the folder where data sets lie."""


def is_procedural(families: Families, name: str) -> bool:
    """Whether `name` is a family whose scenes are made on the spot, so that no folder is asked for."""
    return name in families and bool(families.entry(name).declared.get("procedural"))


def locate(spec: str, families: Families) -> tuple[Path, str | None]:
    """Find (folder of a scene, name of the data set it was asked by; None for a path).

    `dataset/scene` is $SPLATWIZARD_DATA/dataset/scene, or lies in one of the other `folders` that the family of that
    name declares, with or without its `prefix` before the scene's name.

    Raises SceneError that says what there is instead, and which of it is spelt most alike.
    """
    path = Path(os.path.expanduser(spec))
    if os.path.exists(path):
        return path, None
    *ways, last = "a scene folder", "dataset/scene", *(e.name for e in families if e.declared.get("procedural"))
    cure = f": give {', '.join(ways)}{',' * (len(ways) > 1)} or {last}"
    if path.is_absolute() or spec.startswith("~"):
        raise _missing(spec, cure)
    named = os.environ.get(DATA_VARIABLE)
    if not named:
        raise _missing(spec, f"{cure} (${DATA_VARIABLE} is not set, so dataset/scene names are not looked up)")
    root = Path(os.path.expanduser(named))
    if not os.path.isdir(root):
        raise _missing(spec, f", and ${DATA_VARIABLE} names no folder: {root}")
    parts = path.parts
    if os.path.exists(root / path):
        return root / path, parts[0] if len(parts) == 2 else None
    if len(parts) == 2:
        prefix = families.entry(parts[0]).declared.get("prefix", "") if parts[0] in families else ""
        for home in _homes(root, parts[0], families):
            for scene in dict.fromkeys((parts[1], prefix + parts[1])):
                if os.path.exists(root / home / scene):
                    return root / home / scene, parts[0]
    raise _missing(spec, _what_is_there(root, parts, families))


def _missing(spec: str, rest: str) -> SceneError:
    return SceneError(f"scene '{spec}' is not there{rest}", path=spec)


def _homes(root: Path, dataset: str, families: Families) -> list[str]:
    """The folders of `root` that hold scenes of a data set: its own, and those by whose names its family is known."""
    known = (dataset, *families.entry(dataset).declared.get("folders", ())) if dataset in families else ()
    return [name for name in _folders(root) if name == dataset or name.lower() in known]


def _what_is_there(root: Path, parts: Sequence[str], families: Families) -> str:
    """Rest of the message: how far the name leads, and what could be meant."""
    if len(parts) == 1:
        holders = [name for name in _folders(root) if os.path.isdir(root / name / parts[0])]
        if holders:
            return f": did you mean {holders[0]}/{parts[0]} (below ${DATA_VARIABLE})?"
        return f", nor is {root / parts[0]}: datasets are named as dataset/scene; {_listed(root, parts[0])}"
    homes = _homes(root, parts[0], families)
    if not homes:
        return f", nor is {root / Path(*parts)}: {_listed(root, parts[0])}"
    home = root / homes[0]
    return f", nor is {home / Path(*parts[1:])}: {_listed(home, parts[1])}"


def _listed(folder: Path, wanted: str) -> str:
    names = _folders(folder)
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
