"""Training loop of one stage, independent of the method: pre tasks, render, loss, post tasks, optimizer.

Published numbers depend on three rules. Post tasks run between backward and the optimizer step. A parameter that a task
has replaced has no gradient and is skipped. The last step makes no update.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from splatwizard_core.base.scalars import Verdict
from splatwizard_core.errors import (
    DeviceMemoryError,
    EmptyModel,
    NothingToDo,
    TaskError,
    TrainingDiverged,
    out_of_memory,
)
from splatwizard_core.scene.camera import Camera
from splatwizard_core.scene.scene import View
from splatwizard_core.training.losses import LossPack
from splatwizard_core.training.state import TrainingState
from splatwizard_core.training.task_log import TaskLog
from splatwizard_core.training.timing import StageClock

CHECK_EVERY = 32
"""Steps between questions to a GPU whether the losses are finite; each is answered at the next one, so that none is
waited for. A loss that is not finite ends the training at most twice as many steps later, and before any checkpoint."""


class Loss(NamedTuple):
    """Loss of a step, not yet checked to be finite; `total` and `parts` are detached scalars."""

    step: int
    view: str
    total: Tensor
    parts: dict[str, Tensor]


class Trainer:
    """Runs the steps of one stage.

    state       what is trained; each step brings it on
    stage_clock times every stage of a step (waiting for the device); None: no such timing
    """

    def __init__(self, state: TrainingState, stage_clock: StageClock | None = None) -> None:
        self.state, self.stage_clock = state, stage_clock
        self.device = state.device
        self._one = torch.ones((), device=self.device)
        self._background = state.scene.background.to(self.device)
        self._has_alpha = not state.scene.protocol.composite8
        self._cameras: WeakKeyDictionary[View, Camera] = WeakKeyDictionary()
        self._view: View | None = None
        self._unchecked: list[Loss] = []
        self._asked: tuple[Verdict, list[Loss]] | None = None

    def run(self, until: int, after_step: Callable[[TrainingState], None]) -> None:
        """Run steps from `state.step` + 1 to `until`, or until a task asks to stop.

        after_step  housekeeping, called between steps, when the state is whole

        Raises NothingToDo, TrainingDiverged, EmptyModel, TaskError.
        """
        state, stage = self.state, self.state.stage
        if state.step >= stage.iterations:
            raise NothingToDo(
                f"stage '{stage.name}' ends at step {stage.iterations}, and {state.step} steps are done: "
                "raise `iterations` to train on"
            )
        # Backward in this thread: torch's own for the GPU would be woken up each time, and take the interpreter's lock.
        with torch.autograd.set_multithreading_enabled(False):
            while state.step < min(until, stage.iterations) and not state.stopped:
                try:
                    self.run_step()
                except (EmptyModel, TaskError):
                    self.check_losses()  # what a step with a loss that is not finite leaves behind may have caused it
                    raise
                except torch.cuda.OutOfMemoryError as error:
                    raise self._out_of_memory(error) from error
                after_step(state)
        self.check_losses()

    def run_step(self) -> None:
        """Run the next step, whatever its number."""
        state, stage, mark = self.state, self.state.stage, self._mark
        model, ppl = state.model, state.ppl
        state.step = step = state.step + 1
        if self.stage_clock is not None:
            self.stage_clock.start()
        state.result, state.loss, state.log = None, None, TaskLog()
        with torch.no_grad():
            stop = state.pre.exec(step, state)
        self._check_rows()
        mark("pre")
        view = self._view = state.sampler.next(step)
        state.view = view.name
        background = self._background
        if ppl.random_background or (self._has_alpha and stage.random_background(step)):
            background = torch.rand(3, generator=state.streams("background")).to(self.device, non_blocking=True)
        camera = self._camera(view)
        found = None if self.stage_clock or ppl.clamp_render else stage.whole_step(state, view, camera, background)
        if found is None:
            inputs = model.gaussians(camera, state.rasterizer)
            result = state.rasterizer.render(inputs, camera, stage.raster_options(step, background))
            if ppl.clamp_render:
                result.image = result.image.clamp(0, 1)
            mark("render")
            loss = stage.loss(model, view, result, background, step)
            mark("loss")
            self._backward(loss.total)
            mark("backward")
            found = result, loss
        result, loss = state.result, state.loss = found
        self._keep(loss)
        with torch.no_grad():
            stop = state.post.exec(step, state) or stop
            self._check_rows()
            mark("post")
            if step < stage.iterations:
                state.optimizer.step(result)
        state.optimizer.zero_grad()
        mark("optimize")
        if self.stage_clock is not None:
            state.seconds = self.stage_clock.last_step
        # The graph and its buffers end with the step, not with the next one's render.
        state.result = state.loss = None
        state.stopped = stop

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

    def _keep(self, loss: LossPack) -> None:
        """Store the step's loss in the state; check all unchecked losses every CHECK_EVERY steps."""
        state = self.state
        state.total = loss.total.detach()
        state.parts = {name: part.detach() if part.requires_grad else part for name, part in loss.parts.items()}
        self._unchecked.append(Loss(state.step, state.view, state.total, state.parts))
        # On a CPU a look costs a microsecond, so it happens before a bad gradient can spread.
        if self.device.type == "cpu":
            self.check_losses()
        elif len(self._unchecked) >= CHECK_EVERY:
            self._look()

    def check_losses(self) -> None:
        """Raise TrainingDiverged if a loss since the last look is not finite. Waits for the device."""
        self._look()
        self._look()  # hears what the first has asked

    def _look(self) -> None:
        """Read the result of the previous check, or raise TrainingDiverged; start a check of newer losses."""
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
        state, view = self.state, self._view
        rows = f"{state.num_rows:,} {state.model.ROW_LABEL}"
        drawn = "" if view is None else f" at {view.camera.width}x{view.camera.height}"
        return out_of_memory(
            error,
            f"step {state.step} of stage '{state.stage.name}' with {rows}{drawn}",
            "free the GPU and give the same command again, it goes on from the last checkpoint; "
            "smaller pictures, or a plan that makes fewer, start anew",
        )

    def _check_rows(self) -> None:
        if self.state.model.ROWS and self.state.num_rows == 0:
            raise EmptyModel(self.state.step)

    def _camera(self, view: View) -> Camera:
        """Return the view's camera on the model's device, copied once per view."""
        if view not in self._cameras:
            self._cameras[view] = view.camera.to(self.device)
        return self._cameras[view]
