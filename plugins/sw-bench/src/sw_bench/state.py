"""States of the runs of a plan, read from their run directories: finished, to do, or holding another training."""

from __future__ import annotations

import json
from collections.abc import Container, Sequence
from enum import Enum
from pathlib import Path
from typing import Any

from splatwizard_core.api import UserInputError
from splatwizard_core.tooling import (
    FILE_NAME,
    OWN_FILES,
    Choices,
    PluginManager,
    Record,
    directory_lock,
    load_plugins,
    read_record,
    recorded_hash,
    remove_folder,
)
from sw_bench.cells import TRAINED, Cell, Job, SharedTraining, training_key

CONFIG = "config.toml"
STEPS = "steps.json"
MOST_TOLD = 3  # values in a message


class State(Enum):
    """State of a run before its process starts."""

    FINISHED = "finished"
    NEW = "new"
    BEGUN = "goes on"
    CHANGED = "changed"


def state_of(cell: Cell, plugins: PluginManager, *, geometry: bool = False) -> State:
    """Return the state of a run.

    geometry    one without measured geometry is not finished

    FINISHED: its record was made with the values that the plan gives it now. BEGUN: its directory holds this
    training, whole or in part; only values that encode may differ. CHANGED: it holds another training.
    """
    record = record_of(cell)
    if record is not None and not (geometry and record.geometry is None):
        return State.FINISHED
    config = cell.directory / CONFIG
    if not config.exists():
        return State.NEW
    try:
        (before,) = Choices(config_file=str(config)).resolve(plugins)
    except (UserInputError, ValueError):  # of another release, or damaged: the run itself says what to do
        return State.BEGUN
    return State.BEGUN if training_key(before) == cell.training else State.CHANGED


def changes_of(cell: Cell, plugins: PluginManager) -> str:
    """Return which values of a changed run were others, in a few words: `iterations 600 -> 7000`."""
    (before,) = Choices(config_file=str(cell.directory / CONFIG)).resolve(plugins)
    was, now = (_leaves(each.as_dict()) for each in (before, cell.resolved))
    blocks = ("config.", "pipeline.", "scene.", "pretrained.")
    keys = [key for key in {**was, **now} if was.get(key) != now.get(key) and key.startswith((*blocks, "init"))]
    told = [f"{key.removeprefix(key.partition('.')[0] + '.')} {was.get(key)} -> {now.get(key)}" for key in keys]
    return ", ".join(told[:MOST_TOLD]) + (", ..." if len(told) > MOST_TOLD else "")


def _leaves(table: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in table.items():
        found |= _leaves(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return found


def discard(cell: Cell) -> None:
    """Remove what a run has left in its directory, as `--fresh` does; other files stay."""
    _clear(cell.directory)


def discard_shared(shared: SharedTraining) -> None:
    """Remove a training for several and its note; where it was cannot be known without the note."""
    directory = _noted(shared)
    shared.note.unlink(missing_ok=True)
    if directory is not None and directory.parent == (shared.root / TRAINED).resolve():
        _clear(directory)


def _clear(directory: Path) -> None:
    if not directory.exists():
        return
    with directory_lock(directory):
        for path in (directory / name for name in OWN_FILES):
            if path.is_dir() and not path.is_symlink():
                remove_folder(path)
            else:
                path.unlink(missing_ok=True)


def record_of(cell: Cell) -> Record | None:
    """Return the record of a run, of any release, if it was made with the values that the plan gives it now."""
    path = cell.directory / FILE_NAME
    if not path.exists():
        return None
    try:
        record = read_record(path)
    except UserInputError:
        return None
    asked = cell.resolved.config_hash()
    return record if asked in (record.config_hash, recorded_hash(load_plugins(), record)) else None


def stamp_of(cell: Cell) -> tuple[int, int] | None:
    """Return what changes whenever the record of a run is written; None: there is no record of these values."""
    if record_of(cell) is None:
        return None
    try:
        facts = (cell.directory / FILE_NAME).stat()
    except OSError:
        return None
    return facts.st_mtime_ns, facts.st_ino


def is_trained(directory: Path) -> bool:
    """Whether a directory says that its training is finished."""
    try:
        steps = json.loads((directory / STEPS).read_text("utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(steps, dict) and "train" in steps


def is_shared_training_done(shared: SharedTraining) -> bool:
    """Whether a training for several was finished, and is still there."""
    directory = _noted(shared)
    return directory is not None and is_trained(directory)


def left_to_do(jobs: Sequence[Job], again: Container[str] = ()) -> list[Job]:
    """Return the jobs without finished trainings for several, which then nothing has to wait for.

    again       `cells.training_key` of trainings that are about to be discarded
    """
    done = {
        job for job in jobs
        if job.shared is not None and training_key(job.shared.resolved) not in again
        and is_shared_training_done(job.shared)
    }  # fmt: skip
    for job in jobs:
        job.needs = tuple(need for need in job.needs if need not in done)
    return [job for job in jobs if job not in done]


def _noted(shared: SharedTraining) -> Path | None:
    """Return where the note of a training for several says that it lies."""
    try:
        return Path(json.loads(shared.note.read_text("utf-8"))["directory"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
