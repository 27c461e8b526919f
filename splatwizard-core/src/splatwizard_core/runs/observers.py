"""The arguments of the hooks around a run: a training that begins, and the runs that one command has finished."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from rich.console import Console

from splatwizard_core.gaussians.splat_model import SplatModel
from splatwizard_core.rendering.rasterizer import Rasterizer
from splatwizard_core.runs.record import Record
from splatwizard_core.scene.scene import Scene
from splatwizard_core.training.trainer import StepRecord


@dataclass(frozen=True)
class StartedTraining:
    """A training that begins or goes on.

    method      name of the method
    directory   the run directory
    scene       with the training views
    rasterizer  draws the model as the training does
    """

    method: str
    directory: Path
    scene: Scene
    rasterizer: Rasterizer


class TrainingObserver(Protocol):
    """Watches a training between its steps; its time is not the training's. One that raises is told and dropped."""

    def after_step(self, model: SplatModel, record: StepRecord) -> None:
        """Called after each step; must leave the model, its gradients and all random streams as they are."""
        ...

    def finished(self) -> None:
        """Called once when the training ends, however it ends."""
        ...


@dataclass(frozen=True)
class FinishedRun:
    """A run directory that is complete.

    open_scene  () -> the scene that it was measured on
    """

    directory: Path
    record: Record
    open_scene: Callable[[], Scene]


@dataclass(frozen=True)
class FinishedRuns:
    """What a command has finished: one run, or at its end all of them.

    complete    the command ends: these are all its runs
    console     where tables may be printed; None: the user asked for JSON
    say         takes one-line messages for the user
    written     files that are named to the user at the end, those of single runs first; a hook appends what it wrote,
                and may take back its own
    """

    runs: Sequence[FinishedRun]
    complete: bool
    console: Console | None
    say: Callable[[str], None]
    written: list[Path] = field(default_factory=list)
