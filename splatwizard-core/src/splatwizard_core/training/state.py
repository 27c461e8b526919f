"""Complete state of a training: arguments of tasks, view of observers, content of checkpoints."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from splatwizard_core.base.random_states import capture_random_states, restore_random_states
from splatwizard_core.gaussians.splat_model import SplatModel
from splatwizard_core.rendering.rasterizer import Rasterizer
from splatwizard_core.scene.scene import Scene
from splatwizard_core.streams import Streams
from splatwizard_core.training.checkpoint import Checkpoint, normalised
from splatwizard_core.training.measurements import TrainingFigures
from splatwizard_core.training.params import PipelineParams
from splatwizard_core.training.scheduler import Scheduler, build_schedulers
from splatwizard_core.training.stage import CameraIterator, CameraSampler, Stage
from splatwizard_core.training.tasks import SOURCES, TaskContext


@dataclass(kw_only=True, repr=False)
class TrainingState(TaskContext):
    """A training at a step of one of its stages; `TaskContext` has the model, the optimizer, and the step's results.

    stage       that is trained
    index       its position in the run
    name        of the stage in records, unique in the run
    streams     its random streams
    sampler     says which view is next
    figures     seconds, steps and memory of all stages; the step of this one is there and nowhere else
    stopped     a task asked to end the stage, or it has been ended before
    view        name of the view that the last step drew
    total, parts    loss of the last step, detached scalars: reading one waits for a GPU
    seconds     of the last step by part; empty unless they are timed
    """

    stage: Stage
    index: int
    name: str
    streams: Streams
    sampler: CameraSampler
    pre: Scheduler
    post: Scheduler
    figures: TrainingFigures = field(default_factory=TrainingFigures)
    stopped: bool = False
    view: str = ""
    total: Tensor = field(default_factory=lambda: torch.zeros(()))
    parts: dict[str, Tensor] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)

    @classmethod
    def begin(
        cls,
        stage: Stage,
        model: SplatModel,
        scene: Scene,
        ppl: PipelineParams,
        rasterizer: Rasterizer,
        streams: Streams,
        *,
        index: int = 0,
        name: str = "",
        figures: TrainingFigures | None = None,
    ) -> TrainingState:
        """Return the state before the first step of a stage. Raises TaskSignatureError for a task that asks for more.

        name    default: the stage's
        """
        pre, post = build_schedulers(stage, ppl)
        state = cls(
            ppl, stage.opt, model, scene, stage.create_optimizer(model, scene), CameraIterator(scene.train), rasterizer,
            stage=stage, index=index, name=name or stage.name, streams=streams,
            sampler=stage.create_sampler(scene, streams("sampler")), pre=pre, post=post,
            figures=figures or TrainingFigures(),
        )  # fmt: skip
        for scheduler in (pre, post):
            scheduler.check(state)
        return state

    @property
    def state(self) -> TrainingState:
        """The state itself, for tasks that ask for it."""
        return self

    @property
    def device(self) -> torch.device:
        """Device of the model."""
        return self.model.device

    @property
    def stage_name(self) -> str:
        """Name of the stage."""
        return self.stage.name

    @property
    def iterations(self) -> int:
        """Steps of the stage."""
        return self.stage.iterations

    @property
    def finished(self) -> bool:
        """Whether the stage is over."""
        return self.stopped or self.step >= self.stage.iterations

    @property
    def num_rows(self) -> int:
        """Number of primitives, such as Gaussians; 0 for a model without any."""
        return self.model.num_rows if self.model.ROWS else 0

    @property
    def said(self) -> list[tuple[str, str]]:
        """(task, line) that the tasks of the last step said, as `TaskLog` has them."""
        return self.log.said

    @property
    def scalars(self) -> dict[str, Tensor]:
        """Curve -> value that the tasks of the last step recorded."""
        return self.log.scalars

    def plan_lines(self) -> list[str]:
        """Return lines that identify the stage's plan."""
        return [*self.pre.plan_lines(), *self.post.plan_lines()]

    def checkpoint(self, identity: Mapping[str, Any]) -> Checkpoint:
        """Return the checkpoint of this step.

        identity    what the training depends on besides its plan
        """
        return Checkpoint(
            stage=self.index, stage_name=self.stage.name, step=self.step, finished=self.finished,
            identity=normalised(identity), plan=self.plan_lines(), extent=self.scene.extent, progress=self.figures,
            state=self.state_dict(),
        )  # fmt: skip

    def state_dict(self) -> dict[str, Any]:
        """Return all that the next step depends on, tensors and JSON-able values in nested dicts; no copies."""
        kept = {key: task.state_dict() for key, task in self._keeping_tasks()}
        return {
            "model": self.model.state_dict(),
            "extra": self.model.state_dict_extra(),
            "optimizer": self.optimizer.state_dict(),
            "sampler": self.sampler.state_dict(),
            "streams": self.streams.state_dict(),
            "rng": capture_random_states(),
            **({"tasks": kept} if kept else {}),
        }

    def load_state_dict(self, state: Mapping[str, Any], step: int) -> None:
        """Restore what `state_dict` returned after `step`. Raises the error of the part that does not fit."""
        self.model.load_resized(state["model"])
        self.model.load_state_dict_extra(state["extra"])
        self.optimizer.load_state_dict(state["optimizer"])
        # The sampler's generator is one of the streams: both hold the same state.
        self.streams.load_state_dict(state["streams"])
        self.sampler.load_state_dict(state["sampler"])
        kept = state.get("tasks", {})
        for key, task in self._keeping_tasks():
            if key in kept:  # a release before 0.3 kept nothing of tasks
                task.load_state_dict(kept[key])
        restore_random_states(state["rng"])
        self.step = step

    def _keeping_tasks(self) -> Iterator[tuple[str, Any]]:
        """Yield the tasks of the plan that have a `state_dict` of their own, each with its place in the plan."""
        for entry in (*self.pre.registrations, *self.post.registrations):
            if entry.after == 0 and hasattr(entry.task, "state_dict") and hasattr(entry.task, "load_state_dict"):
                yield f"{entry.stage} {entry.order}: {entry.name}", entry.task


SOURCES[TrainingState] = "state"
