"""The arguments of the hooks around a run: a training that begins, and the runs that one command has finished."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import torch

from splatwizard_core.gaussians.splat_model import SplatModel
from splatwizard_core.plugins import PluginManager
from splatwizard_core.plugins.guards import one_line
from splatwizard_core.plugins.origins import Origins
from splatwizard_core.rendering.rasterizer import Rasterizer
from splatwizard_core.runs.record import Record
from splatwizard_core.scene.scene import Scene
from splatwizard_core.training.housekeeping import OnStep
from splatwizard_core.training.params import LogParams
from splatwizard_core.training.state import TrainingState

if TYPE_CHECKING:
    from rich.console import Console

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class StartedTraining:
    """A training that begins or goes on.

    method      name of the method
    directory   the run directory
    scene       with the training views
    rasterizer  draws the model as the training does
    log         what else the user wants it logged for
    """

    method: str
    directory: Path
    scene: Scene
    rasterizer: Rasterizer
    log: LogParams = field(default_factory=LogParams)


class TrainingObserver(Protocol):
    """Watches a training between its steps; its time is not the training's. One that raises is told and dropped."""

    def after_step(self, model: SplatModel, state: TrainingState) -> None:
        """Called after each step; must leave the training, its gradients and all random streams as they are."""
        ...

    def finished(self) -> None:
        """Called once when the training ends, however it ends."""
        ...


@contextlib.contextmanager
def watched_by(
    observers: Iterable[TrainingObserver | None], plugins: PluginManager, say: Callable[[str], None]
) -> Iterator[OnStep | None]:
    """Yield the function that tells the observers of a step (None: there are none), and tell them of the end.

    Each can fail alone: what it raises is said with its package, and it is told of nothing more.
    """
    watching = [each for each in observers if each is not None]

    def tell(call: Callable[[TrainingObserver], None]) -> None:
        for observer in list(watching):
            try:
                with torch.set_grad_enabled(torch.is_grad_enabled()):  # as it was, whatever it does
                    call(observer)
            except (Exception, SystemExit) as error:
                log.debug("an observer of the training failed", exc_info=True)
                watching.remove(observer)
                distribution, version = Origins(plugins).of(observer)
                whose = f" of {distribution} {version}" if distribution else ""
                say(f"warning: observer {type(observer).__name__}{whose} is dropped: {one_line(error)}")
                with contextlib.suppress(Exception, SystemExit):
                    observer.finished()

    def after_step(model: SplatModel, state: TrainingState) -> None:
        tell(lambda observer: observer.after_step(model, state))

    try:
        yield after_step if watching else None
    finally:
        tell(lambda observer: observer.finished())


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
    """The runs that a command has finished: one, or at its end all of them.

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
