"""The loop of one training stage: pre tasks, render, loss, post tasks, optimizer. It knows no method.

What published numbers depend on: post tasks run between backward and the optimizer step; a parameter that a task
has replaced has no gradient and is skipped; the last step makes no update.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from splatwizard_core.errors import EmptyModel, NothingToDo, TaskError, TrainingDiverged
from splatwizard_core.gaussians.splat_model import SplatModel
from splatwizard_core.rendering.rasterizer import Rasterizer
from splatwizard_core.scene.camera import Camera
from splatwizard_core.scene.scene import Scene, View
from splatwizard_core.training.losses import LossPack
from splatwizard_core.training.params import PipelineParams
from splatwizard_core.training.rng import Streams
from splatwizard_core.training.scheduler import build_schedulers
from splatwizard_core.training.stage import CameraIterator, Stage
from splatwizard_core.training.task_log import TaskLog
from splatwizard_core.training.tasks import TaskContext
from splatwizard_core.training.timing import StageClock
from splatwizard_native import (
    DeviceMemoryError,
    Verdict,
    capture_random_states,
    out_of_memory,
    restore_random_states,
)

CHECK_EVERY = 32
"""Steps between questions to a GPU whether the losses are finite; each is answered at the next one, so that none is
waited for. A loss that is not finite ends the training at most twice as many steps later, and before any checkpoint."""


@dataclass
class StepRecord:
    """One finished step, as cheap as it can be: tensors are read (and the device waited for) only by who needs them.

    step        1-based, of this stage
    total, parts    the loss, detached scalars
    num_rows    primitives after the step
    said, scalars   what its tasks left, as of `TaskLog`
    seconds     per stage; empty unless stages are timed
    """

    stage: int
    stage_name: str
    step: int
    iterations: int
    view: str
    total: Tensor
    parts: dict[str, Tensor] = field(default_factory=dict)
    num_rows: int = 0
    said: list[tuple[str, str]] = field(default_factory=list)
    scalars: dict[str, Tensor] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)


@dataclass
class Trainer:
    """Runs the steps of one stage on a model.

    index       position of the stage in the run
    streams     the stage's random streams
    stage_clock times every stage of a step (waiting for the device); None: no such timing
    step        the last finished step
    stopped     a task asked to end the stage
    """

    stage: Stage
    model: SplatModel
    scene: Scene
    ppl: PipelineParams
    rasterizer: Rasterizer
    streams: Streams
    index: int = 0
    stage_clock: StageClock | None = None
    step: int = field(default=0, init=False)
    stopped: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        stage, model, scene = self.stage, self.model, self.scene
        self.device = model.device
        self.optimizer = stage.create_optimizer(model, scene)
        self.sampler = stage.create_sampler(scene, self.streams("sampler"))
        self.pre, self.post = build_schedulers(stage, self.ppl)
        self.context = TaskContext(
            self.ppl, stage.opt, model, scene, self.optimizer, CameraIterator(scene.train), self.rasterizer
        )
        self.pre.check(self.context)
        self.post.check(self.context)
        self._view: View | None = None
        self._one = torch.ones((), device=self.device)
        self._background = scene.background.to(self.device)
        self._has_alpha = not scene.protocol.composite8
        self._cameras: WeakKeyDictionary[View, Camera] = WeakKeyDictionary()
        self._unchecked: list[StepRecord] = []
        self._asked: tuple[Verdict, list[StepRecord]] | None = None

    def run(self, until: int, after_step: Callable[[StepRecord], None]) -> None:
        """Run the steps after `self.step` up to `until`, or to the one after which a task wants to stop.

        after_step  housekeeping, called between steps, when the state is whole

        Raises NothingToDo, TrainingDiverged, EmptyModel, TaskError.
        """
        if self.step >= self.stage.iterations:
            raise NothingToDo(
                f"stage '{self.stage.name}' ends at step {self.stage.iterations}, and {self.step} steps are done: "
                "raise `iterations` to train on"
            )
        # Backward in this thread: torch's own for the GPU would be woken up each time, and take the interpreter's lock.
        with torch.autograd.set_multithreading_enabled(False):
            self._run_steps(until, after_step)
        self.check_losses()

    def _run_steps(self, until: int, after_step: Callable[[StepRecord], None]) -> None:
        while self.step < min(until, self.stage.iterations) and not self.stopped:
            try:
                record = self._run_step(self.step + 1)
            except (EmptyModel, TaskError):
                self.check_losses()  # what a step with a loss that is not finite leaves behind may have caused it
                raise
            except torch.cuda.OutOfMemoryError as error:
                raise self._out_of_memory(error) from error
            self.step += 1
            after_step(record)

    def _run_step(self, step: int) -> StepRecord:
        context, mark = self.context, self._mark
        if self.stage_clock is not None:
            self.stage_clock.start()
        context.result, context.loss, context.log = None, None, TaskLog()
        with torch.no_grad():
            stop = self.pre.exec(step, context)
        self._check_rows(step)
        mark("pre")

        view = self._view = self.sampler.next(step)
        background = self._background
        if self.ppl.random_background or (self._has_alpha and self.stage.random_background(step)):
            background = torch.rand(3, generator=self.streams("background")).to(self.device, non_blocking=True)
        camera = self._camera(view)
        inputs = self.model.gaussians(camera, self.rasterizer)
        result = self.rasterizer.render(inputs, camera, self.stage.raster_options(step, background))
        if self.ppl.clamp_render:
            result.image = result.image.clamp(0, 1)
        mark("render")

        loss = self.stage.loss(self.model, view, result, background, step)
        record = self._record(step, view, loss)
        mark("loss")
        self._backward(loss.total)
        mark("backward")

        context.result, context.loss = result, loss
        with torch.no_grad():
            stop = self.post.exec(step, context) or stop
            self._check_rows(step)
            mark("post")
            if step < self.stage.iterations:
                self.optimizer.step(result)
        self.optimizer.zero_grad()
        mark("optimize")
        if self.stage_clock is not None:
            record.seconds = self.stage_clock.last_step
        # The graph and its buffers end with the step, not with the next one's render.
        context.result = context.loss = None
        self.stopped = stop
        record.num_rows, record.said, record.scalars = self._num_rows(), context.log.said, context.log.scalars
        return record

    def _mark(self, part: str) -> None:
        if self.stage_clock is not None:
            self.stage_clock.mark(part)

    def _backward(self, total: Tensor) -> None:
        if total.dim() > 0 or total.dtype != self._one.dtype or total.device != self._one.device:
            total.backward()  # type: ignore[no-untyped-call]
            return
        # `backward(one)` would import sympy to compare two shapes, which takes seconds, and `backward()` makes a one of
        # its own at each step: so the engine is called as both would.
        engine: Any = torch.autograd.Variable._execution_engine
        engine.run_backward((total,), (self._one,), False, False, (), allow_unreachable=True, accumulate_grad=True)

    def _record(self, step: int, view: View, loss: LossPack) -> StepRecord:
        parts = {name: part.detach() if part.requires_grad else part for name, part in loss.parts.items()}
        record = StepRecord(
            self.index, self.stage.name, step, self.stage.iterations, view.name, loss.total.detach(), parts
        )
        self._unchecked.append(record)
        # On a CPU a look costs a microsecond, so it happens before a bad gradient can spread.
        if self.device.type == "cpu":
            self.check_losses()
        elif len(self._unchecked) >= CHECK_EVERY:
            self._look()
        return record

    def check_losses(self) -> None:
        """Raise TrainingDiverged if a loss since the last look is not finite. Waits for the device."""
        self._look()
        self._look()  # hears what the first has asked

    def _look(self) -> None:
        """Hear what was asked at the last look, or raise TrainingDiverged; ask about the losses since."""
        asked, self._asked = self._asked, None
        if asked is not None and not asked[0].fine():
            record = next(r for r in asked[1] if not math.isfinite(r.total.item()))
            values = {name: part.item() for name, part in {**record.parts, "total": record.total}.items()}
            part = next(name for name, value in values.items() if not math.isfinite(value))
            raise TrainingDiverged(record.step, record.view, part, values[part])
        if self._unchecked:
            self._asked = Verdict([r.total for r in self._unchecked]), self._unchecked
            self._unchecked = []

    def _out_of_memory(self, error: torch.cuda.OutOfMemoryError) -> DeviceMemoryError:
        view, rows = self._view, f"{self._num_rows():,} {self.model.ROW_LABEL}"
        drawn = "" if view is None else f" at {view.camera.width}x{view.camera.height}"
        return out_of_memory(
            error,
            f"step {self.step + 1} of stage '{self.stage.name}' with {rows}{drawn}",
            "free the GPU and give the same command again, it goes on from the last checkpoint; "
            "smaller pictures, or a plan that makes fewer, start anew",
        )

    def _num_rows(self) -> int:
        return self.model.num_rows if self.model.ROWS else 0

    def _check_rows(self, step: int) -> None:
        if self.model.ROWS and self.model.num_rows == 0:
            raise EmptyModel(step)

    def _camera(self, view: View) -> Camera:
        """Return the view's camera on the model's device, where it is moved once."""
        if view not in self._cameras:
            self._cameras[view] = view.camera.to(self.device)
        return self._cameras[view]

    def plan_lines(self) -> list[str]:
        """Return what identifies the plan of the stage."""
        return [*self.pre.plan_lines(), *self.post.plan_lines()]

    def state_dict(self) -> dict[str, Any]:
        """Return all that the next step depends on, tensors and JSON-able values in nested dicts; no copies."""
        return {
            "model": self.model.state_dict(),
            "extra": self.model.state_dict_extra(),
            "optimizer": self.optimizer.state_dict(),
            "sampler": self.sampler.state_dict(),
            "streams": self.streams.state_dict(),
            "rng": capture_random_states(),
        }

    def load_state_dict(self, state: dict[str, Any], step: int) -> None:
        """Restore what `state_dict` returned after `step`. Raises the error of the part that does not fit."""
        self.model.load_resized(state["model"])
        self.model.load_state_dict_extra(state["extra"])
        self.optimizer.load_state_dict(state["optimizer"])
        # The sampler's generator is one of the streams: both hold the same state.
        self.streams.load_state_dict(state["streams"])
        self.sampler.load_state_dict(state["sampler"])
        restore_random_states(state["rng"])
        self.step = step
