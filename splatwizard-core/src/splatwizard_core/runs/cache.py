"""Trained scenes that other trainings start from, made once for each scene and configuration."""

from __future__ import annotations

from pathlib import Path

from splatwizard_core.files import sweep
from splatwizard_core.runs.config import ResolvedConfig
from splatwizard_core.runs.lock import directory_lock, is_held
from splatwizard_core.runs.session import Session, TrainedModel
from splatwizard_core.runs.start import base_config, first_scene, make_method, training_key
from splatwizard_core.runs.steps import StepLog
from splatwizard_core.runs.training_run import BEGUN, CHECKPOINTS, STEP, holds_training, train
from splatwizard_core.training.checkpoint import CheckpointStore

FOLDER = ".trained"  # inside the output root: what is trained for a run stays with the runs


def trained_scene(session: Session, name: str, outer: ResolvedConfig, out: Path) -> TrainedModel:
    """The trained scene of method `name`, frozen: the file that `outer` names, from an ordinary run under `out`, from
    the cache, or trained now.

    Two processes that want the same one train it once: the second waits for the first.
    """
    if outer.init and name == first_scene(make_method(session.plugins, outer)):
        session.say_once(f"{outer.method} starts from {outer.init} in place of a trained {name} scene")
        return session.given(Path(outer.init))
    resolved = base_config(session.plugins, name, outer)
    key = training_key(session, resolved)
    known = session.start(key)
    if known is not None:
        return known

    def nested(inner: str) -> TrainedModel:
        return trained_scene(session, inner, resolved, out)

    directory = _ordinary_run(out / session.scene(resolved).name / name, key)
    if directory is None:
        directory = cached_directory(session, resolved, out, key)
    with directory_lock(directory, wait=True, on_wait=session.say, say=session.say):
        sweep(directory)
        if StepLog(directory).done(STEP, key) is not None:
            session.say_once(f"{outer.method} starts from the trained {name} scene in {directory}")
        elif CheckpointStore(directory / CHECKPOINTS).paths():
            session.say(f"the trained {name} scene for this configuration is not finished yet: going on with it first")
        else:
            session.say(f"no trained {name} scene for this configuration yet: training it first")
        found = train(session, resolved, directory, trained=nested)
    found.model.eval().requires_grad_(False)
    session.remember_start(found)
    return found


def cached_directory(session: Session, resolved: ResolvedConfig, out: Path, key: str) -> Path:
    """Where the trained scene of a configuration is kept for those that start from it."""
    return out / FOLDER / f"{session.scene(resolved).name}-{resolved.method}-{key[:16]}"


def _ordinary_run(parent: Path, key: str) -> Path | None:
    """A run directory that holds this training, finished; else one in which another process is making it right now."""
    directories = sorted(parent.iterdir()) if parent.is_dir() else []
    for directory in directories:
        if holds_training(directory, key):
            return directory
    for directory in directories:
        if StepLog(directory).done(BEGUN, key) is not None and is_held(directory):
            return directory
    return None
