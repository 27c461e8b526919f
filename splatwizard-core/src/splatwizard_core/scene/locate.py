"""Finds the folder of a scene: a path as it stands, or `dataset/scene` below $SPLATWIZARD_DATA."""

from __future__ import annotations

import difflib
import os
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
    dataset, *inner = path.parts
    if os.path.exists(root / path):
        return root / path, dataset if len(inner) == 1 else None
    declared = families.entry(dataset).declared if dataset in families else {}
    known = (dataset, *declared.get("folders", ())) if dataset in families else ()
    homes = [root / name for name in _folders(root) if name == dataset or name.lower() in known]
    if len(inner) == 1:
        names = dict.fromkeys((inner[0], declared.get("prefix", "") + inner[0]))
        for place in (home / name for home in homes for name in names):
            if os.path.exists(place):
                return place, dataset
    raise _missing(spec, _what_is_there(root, dataset, inner, homes))


def _missing(spec: str, rest: str) -> SceneError:
    return SceneError(f"scene '{spec}' is not there{rest}", path=spec)


def _what_is_there(root: Path, dataset: str, inner: list[str], homes: list[Path]) -> str:
    """Rest of the message: how far the name leads, and what could be meant."""
    if inner and homes:
        return f", nor is {homes[0].joinpath(*inner)}: {_listed(homes[0], inner[0])}"
    if inner:
        return f", nor is {root.joinpath(dataset, *inner)}: {_listed(root, dataset)}"
    holders = [name for name in _folders(root) if os.path.isdir(root / name / dataset)]
    if holders:
        return f": did you mean {holders[0]}/{dataset} (below ${DATA_VARIABLE})?"
    return f", nor is {root / dataset}: datasets are named as dataset/scene; {_listed(root, dataset)}"


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
