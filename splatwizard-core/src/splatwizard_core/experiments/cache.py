"""Trained scenes that other trainings start from, made once for each scene and configuration."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from splatwizard_core.experiments.config import ResolvedConfig, apply_overrides, resolve
from splatwizard_core.experiments.keys import field_at
from splatwizard_core.experiments.lock import directory_lock
from splatwizard_core.experiments.session import Session, TrainedModel
from splatwizard_core.experiments.steps import StepLog
from splatwizard_core.experiments.training_run import STEP, holds_training, train, training_key
from splatwizard_core.files import sweep
from splatwizard_core.training.params import PipelineParams

FOLDER = ".trained"  # inside the output root: what is trained for a run stays with the runs


def base_config(session: Session, name: str, outer: ResolvedConfig) -> ResolvedConfig:
    """How a scene that `outer` starts from is trained: same preset if the method has it, same run and scene options."""
    cls = session.plugins.methods.load(name)
    preset = outer.preset if outer.preset in cls.PRESETS else "paper"
    base = resolve(cls, preset)
    # What a preset says about the run (clamped renders, say) belongs to the base method; the rest is as outside.
    said = {key: value for key, value in cls.PRESETS[preset].items() if field_at(PipelineParams, key) is not None}
    ppl = apply_overrides(outer.ppl, said, source=f"preset '{preset}' of '{name}'")
    return replace(base, ppl=ppl, scene=outer.scene, scene_spec=outer.scene_spec)


def trained_scene(session: Session, name: str, outer: ResolvedConfig, out: Path) -> TrainedModel:
    """The trained scene of method `name`, frozen: from an ordinary run under `out`, from the cache, or trained now.

    Two processes that want the same one train it once: the second waits for the first.
    """
    resolved = base_config(session, name, outer)
    key = training_key(session, resolved)
    scene = session.scene(resolved)

    def nested(inner: str) -> TrainedModel:
        return trained_scene(session, inner, resolved, out)

    directory = _ordinary_run(out / scene.name / name, key)
    if directory is None:
        directory = out / FOLDER / f"{scene.name}-{name}-{key[:16]}"
    with directory_lock(directory, wait=True, on_wait=session.say, say=session.say):
        sweep(directory)
        if StepLog(directory).done(STEP, key) is None:
            session.say(f"{outer.method} starts from a trained {name} scene; none is there yet, so it is trained first")
        found = train(session, resolved, directory, trained=nested)
    found.model.eval().requires_grad_(False)
    return found


def _ordinary_run(parent: Path, key: str) -> Path | None:
    """A run directory that holds this training, finished."""
    for directory in sorted(parent.iterdir()) if parent.is_dir() else []:
        if holds_training(directory, key):
            return directory
    return None
