"""The work between the steps of a stage: log, progress, evaluation, checkpoints, Ctrl-C."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from splatwizard_core.base.interrupt import InterruptGuard
from splatwizard_core.base.memory import synchronize
from splatwizard_core.base.progress import track
from splatwizard_core.base.random_states import preserved_random_states
from splatwizard_core.base.scalars import read_scalars
from splatwizard_core.gaussians.splat_model import SplatModel
from splatwizard_core.training.state import TrainingState
from splatwizard_core.training.timing import LoopClock

if TYPE_CHECKING:
    from splatwizard_core.training.pipeline import TrainingRun
    from splatwizard_core.training.trainer import Trainer

log = logging.getLogger(__name__)

Evaluate = Callable[[SplatModel, int], Mapping[str, Any] | None]
OnStep = Callable[[SplatModel, TrainingState], None]
"""Callback after each step, (model, training state); must not change them."""

UNREAD_LINES = 8  # log lines whose losses stay on a GPU until they are read together: each reading waits for it


class Line(NamedTuple):
    """A log line whose tensors are still on the device; `facts` are plain values."""

    step: int
    total: Tensor
    parts: dict[str, Tensor]
    scalars: dict[str, Tensor]
    facts: dict[str, Any]


class Housekeeping:
    """The work between the steps of one stage. `Trainer.run` runs inside `around`, and calls `after_step`."""

    def __init__(self, run: TrainingRun, trainer: Trainer) -> None:
        self.run, self.trainer, self.state = run, trainer, trainer.state
        self.guard = InterruptGuard()
        self.clock = LoopClock(self.state.figures.stage_seconds.get(self.state.name, 0.0))
        self._unread: list[Line] = []
        self._saved_at = -1

    @contextmanager
    def around(self) -> Iterator[None]:
        """Time the loop and show its progress."""
        run, state = self.run, self.state
        label = f"train {run.identity.get('method', state.name)}"
        if len(run.stages) > 1:
            label += f": {state.name} ({state.index + 1} of {len(run.stages)})"
        bar = track(label, total=state.iterations, start=state.step, foretells=True)
        with bar as self._bar:
            self.clock.start()
            try:
                yield
                synchronize(state.device)
            finally:
                self.clock.stop()
                self._write_lines()

    def after_step(self, state: TrainingState) -> None:
        """Do everything that is due after this step."""
        run, ppl, model = self.run, state.ppl, state.model
        due = run.evaluate is not None and ppl.eval_every and state.step % ppl.eval_every == 0
        if due:
            synchronize(state.device)  # what is still at work there belongs to the training
        self.clock.stop()
        try:
            self._bar.advance(1, loss=state.total, **{model.ROW_LABEL: state.num_rows})
            self._log_step()
            with self.guard.interruptible():
                if run.on_step is not None:
                    with preserved_random_states():
                        run.on_step(model, state)
                if due and run.evaluate is not None:
                    self._evaluate(run.evaluate)
                if not state.finished and state.step % ppl.checkpoint_every == 0:
                    self.save()
        except KeyboardInterrupt:
            # Between steps the state is whole, so nothing that is done is lost. After the last one the stage is
            # over: a resumed run must neither train past a STOP nor find that there is nothing to do.
            self.save()
            raise
        finally:
            self.clock.start()

    def save(self) -> None:
        """Write a checkpoint of the last step unless it exists, or a pending task cannot be saved."""
        run, state = self.run, self.state
        if not state.finished:
            if self._saved_at == state.step:
                return
            if state.pre.pending_late(state.step) or state.post.pending_late(state.step):
                log.warning(
                    "no checkpoint at step %d: a task that was registered while training is still to run", state.step
                )
                return
        self.trainer.check_losses()
        self._write_lines()
        self._account()
        if run.store is not None:
            with run.meter.excluded():
                run.store.write(state.checkpoint(run.identity))
        self._saved_at = state.step

    def _account(self) -> None:
        """Bring the accumulated figures up to date."""
        figures, name, clock = self.state.figures, self.state.name, self.trainer.stage_clock
        figures.rasterizers |= getattr(self.state.rasterizer, "choices", {})
        figures.stage_seconds[name], figures.stage_steps[name] = self.clock.seconds, self.state.step
        figures.peak_bytes = max(figures.peak_bytes or 0, self.run.meter.peak_bytes())
        figures.memory_kind = self.run.meter.kind
        if clock is not None:
            figures.breakdown_s = {**(figures.breakdown_s or {}), name: dict(clock.totals)}
        known = figures.provided.setdefault(name, [])
        known += [part for part in self.run.provided() if part not in known]

    def _evaluate(self, evaluate: Evaluate) -> None:
        state, model = self.state, self.state.model
        modes = {module: module.training for module in model.modules()}
        # Peak memory is that of the loop alone; an evaluation measures memory of its own.
        with self.run.meter.excluded(), preserved_random_states(), torch.no_grad():
            model.eval()
            try:
                metrics = evaluate(model, state.step)
            finally:
                for module, mode in modes.items():
                    module.training = mode
        if metrics:
            seconds = {**state.figures.stage_seconds, state.name: self.clock.seconds}
            self.run.run_log.write(state.index, state.step, metrics=dict(metrics), train_s=sum(seconds.values()))

    def _log_step(self) -> None:
        state = self.state
        for task, said in state.said:
            self.run.run_log.write(state.index, state.step, task=task, **({"said": said} if said else {}))
            if said:
                self._bar.say(f"step {state.step:,}, {task}: {said}")
        if state.step not in (1, state.iterations) and state.step % state.ppl.log_every and not state.scalars:
            return
        facts: dict[str, Any] = {"view": state.view}
        if state.seconds:
            facts["seconds"] = {name: round(seconds, 6) for name, seconds in state.seconds.items()}
        facts["lr"] = {group.name: group.lr for group in state.optimizer.groups.values()}
        self._unread.append(Line(state.step, state.total, state.parts, state.scalars, facts | state.model.counts()))
        if state.device.type == "cpu" or len(self._unread) >= UNREAD_LINES:
            self._write_lines()

    def _write_lines(self) -> None:
        if not self._unread:
            return
        tensors = [x for line in self._unread for x in (line.total, *line.parts.values(), *line.scalars.values())]
        values = iter(read_scalars(tensors))
        for line in self._unread:
            read: dict[str, Any] = {"loss": next(values), "parts": {name: next(values) for name in line.parts}}
            if line.scalars:
                read["scalars"] = {name: next(values) for name in line.scalars}
            self.run.run_log.write(self.state.index, line.step, **read, **line.facts)
        self._unread.clear()
