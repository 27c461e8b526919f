"""Finds scenes of a data set below $SPLATWIZARD_DATA by the names of folders; no file of a scene is read. No torch."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from splatwizard_core.api import UserInputError
from splatwizard_core.tooling import DATA_VARIABLE
from sw_datasets.downloads.registry import DataFile, DataSet
from sw_datasets.families import BENCHMARKS

RECEIPTS = ".fetched"
"""Folder of a data set where `sw data fetch` keeps what it unpacked: one JSON file a scene."""

State = Literal["present", "partly", "missing"]


@dataclass(frozen=True)
class ScenePresence:
    """One scene on disk, or not.

    path        its folder, or where it would be
    state       "partly": the folder is there, but not all that such a scene needs
    lacking     what is not there of DataSet.needs
    verified    True: unpacked by `sw data fetch` from an archive whose SHA-256 was pinned; False: from an unpinned one;
                None: not by `sw data fetch`
    """

    name: str
    path: Path
    state: State
    lacking: tuple[str, ...] = ()
    verified: bool | None = None


def data_root() -> Path:
    """The folder that $SPLATWIZARD_DATA names, there or not. Raises UserInputError if it is not set."""
    named = os.environ.get(DATA_VARIABLE)
    if not named:
        raise UserInputError(
            f"${DATA_VARIABLE} is not set: name the folder where data sets lie, "
            f"as in: export {DATA_VARIABLE}=~/splatwizard-data"
        )
    return Path(named).expanduser().absolute()


def scene_presence(root: Path, dataset: DataSet, scene: str) -> ScenePresence:
    """Find the folder of a scene, and whether all that it needs is there."""
    names = dataset.folder_names(scene)
    for home in homes(root, dataset):
        for name in names:
            path = home / name
            if path.is_dir():
                lacking = tuple(need for need in dataset.needs if not (path / need).exists())
                receipt = read_receipt(home, name)
                verified = None if receipt is None else bool(receipt["archive"].get("verified"))
                return ScenePresence(scene, path, "partly" if lacking else "present", lacking, verified)
    return ScenePresence(scene, root / dataset.folder / names[0], "missing")


def homes(root: Path, dataset: DataSet) -> list[Path]:
    """The folders that hold scenes of the data set: its own, and the names under which it is otherwise unpacked."""
    family = BENCHMARKS.get(dataset.folder)
    try:
        there = sorted(entry.name for entry in os.scandir(root) if entry.is_dir() and not entry.name.startswith("."))
    except OSError:
        return []
    others = [name for name in there if family is not None and name != dataset.folder and family.is_home(name)]
    return [root / name for name in ([dataset.folder] if dataset.folder in there else []) + others]


def dataset_state(root: Path, dataset: DataSet, scenes: list[ScenePresence]) -> State:
    """Whether all scenes (or files) of the data set are present, some, or none."""
    if scenes:
        states: list[State] = [scene.state for scene in scenes]
    else:
        states = [
            "present" if file.into is not None and _brought(root / dataset.folder / file.into, file) else "missing"
            for file in dataset.files
        ]
    if all(state == "present" for state in states):
        return "present" if states else "missing"
    return "missing" if all(state == "missing" for state in states) else "partly"


def _brought(place: Path, file: DataFile) -> bool:
    return (place / file.name).is_file() if file.plain else place.is_dir()


def read_receipt(home: Path, folder: str) -> dict[str, Any] | None:
    """Read the receipt of a scene: {"archive": {...}, "files": {path: [bytes, sha256]}}; None if there is none."""
    try:
        receipt = json.loads((home / RECEIPTS / f"{folder}.json").read_bytes())
    except (OSError, ValueError, RecursionError):
        return None
    whole = isinstance(receipt, dict) and isinstance(receipt.get("archive"), dict)
    return receipt if whole and isinstance(receipt.get("files"), dict) else None
