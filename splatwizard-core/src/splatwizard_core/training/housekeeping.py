"""The work between the steps of a stage: log, progress, evaluation, checkpoints, Ctrl-C."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

import torch

from splatwizard_core.gaussians.splat_model import SplatModel
from splatwizard_core.training.checkpoint import Checkpoint, normalised
from splatwizard_core.training.timing import LoopClock
from splatwizard_core.training.trainer import StepRecord, Trainer
from splatwizard_native import InterruptGuard, preserved_random_states, read_scalars, synchronize, track

if TYPE_CHECKING:
    from splatwizard_core.training.pipeline import TrainingRun

log = logging.getLogger(__name__)

Evaluate = Callable[[SplatModel, int], Mapping[str, Any] | None]
OnStep = Callable[[SplatModel, StepRecord], None]

UNREAD_LINES = 8  # log lines whose losses stay on a GPU until they are read together: each reading waits for it


@dataclass
class Progress:
    """Figures that a run accumulates over processes; part of every checkpoint.

    stage_seconds   stage name -> wall clock of its loop without housekeeping
    stage_steps     stage name -> steps done
    breakdown       stage name -> seconds per stage of a step, where they are timed
    peak_memory     bytes
    rasterizers     features asked for -> who served them
    pictures_in     where the training pictures were: "host" or "cuda"
    provided        stage name -> the rasterizers, pruners, ... that served it, as `TrainingRun.provided` tells
    """

    stage_seconds: dict[str, float] = field(default_factory=dict)
    stage_steps: dict[str, int] = field(default_factory=dict)
    breakdown: dict[str, dict[str, float]] = field(default_factory=dict)
    peak_memory: int = 0
    rasterizers: dict[str, str] = field(default_factory=dict)
    pictures_in: str = "host"
    provided: dict[str, list[dict[str, str]]] = field(default_factory=dict)

    @property
    def steps(self) -> int:
        return sum(self.stage_steps.values())


class Housekeeping:
    """The work between the steps of one stage. `Trainer.run` runs inside `around`, and calls `after_step`.

    name        of the stage in records (unique in the run)
    """

    def __init__(self, run: TrainingRun, trainer: Trainer, name: str) -> None:
        self.run, self.trainer, self.name = run, trainer, name
        self.guard = InterruptGuard()
        self.clock = LoopClock(run.progress.stage_seconds.get(name, 0.0))
        self._unread: list[tuple[StepRecord, dict[str, Any]]] = []
        self._saved_at = -1

    @contextmanager
    def around(self) -> Iterator[None]:
        """The loop, timed and on display."""
        run, trainer = self.run, self.trainer
        label = f"train {run.identity.get('method', self.name)}"
        if len(run.stages) > 1:
            label += f": {self.name} ({trainer.index + 1} of {len(run.stages)})"
        bar = track(label, total=trainer.stage.iterations, start=trainer.step, foretells=True)
        with bar as self._bar:
            self.clock.start()
            try:
                yield
                synchronize(trainer.device)
            finally:
                self.clock.stop()
                self._write_lines()

    def after_step(self, record: StepRecord) -> None:
        """Do everything that is due after this step."""
        run, ppl, model = self.run, self.run.ppl, self.trainer.model
        last = record.step == self.trainer.stage.iterations or self.trainer.stopped
        due = run.evaluate is not None and ppl.eval_every and record.step % ppl.eval_every == 0
        if due:
            synchronize(self.trainer.device)  # what is still at work there belongs to the training
        self.clock.stop()
        try:
            self._bar.advance(1, loss=record.total, **{model.ROW_LABEL: record.num_rows})
            self._log_step(record)
            with self.guard.interruptible():
                if run.on_step is not None:
                    with preserved_random_states():
                        run.on_step(model, record)
                if due and run.evaluate is not None:
                    self._evaluate(run.evaluate, record.step)
                if not last and record.step % ppl.checkpoint_every == 0:
                    self.save()
        except KeyboardInterrupt:
            # Between steps the state is whole, so nothing that is done is lost. After the last one the stage is
            # over: a resumed run must neither train past a STOP nor find that there is nothing to do.
            self.save(finished=last)
            raise
        finally:
            self.clock.start()

    def save(self, *, finished: bool = False) -> None:
        """Write a checkpoint of the last step, unless it is there or a task that it cannot hold is still to run."""
        run, trainer = self.run, self.trainer
        if self._saved_at == trainer.step and not finished:
            return
        if not finished and (trainer.pre.pending_late(trainer.step) or trainer.post.pending_late(trainer.step)):
            log.warning(
                "no checkpoint at step %d: a task that was registered while training is still to run", trainer.step
            )
            return
        trainer.check_losses()
        self._write_lines()
        self._account()
        if run.store is not None:
            with run.meter.excluded():
                run.store.write(
                    Checkpoint(
                        trainer.index, trainer.stage.name, trainer.step, finished, normalised(run.identity),
                        trainer.plan_lines(), run.scene.extent, asdict(run.progress), trainer.state_dict(),
                    )
                )  # fmt: skip
        self._saved_at = trainer.step

    def _account(self) -> None:
        """Bring the accumulated figures up to date."""
        progress = self.run.progress
        progress.rasterizers |= getattr(self.run.rasterizer, "choices", {})
        progress.stage_seconds[self.name] = self.clock.seconds
        progress.stage_steps[self.name] = self.trainer.step
        progress.peak_memory = max(progress.peak_memory, self.run.meter.peak_bytes())
        if self.trainer.stage_clock is not None:
            progress.breakdown[self.name] = dict(self.trainer.stage_clock.totals)
        known = progress.provided.setdefault(self.name, [])
        known += [part for part in self.run.provided() if part not in known]

    def _evaluate(self, evaluate: Evaluate, step: int) -> None:
        model = self.trainer.model
        modes = {module: module.training for module in model.modules()}
        # Peak memory is that of the loop alone; an evaluation measures memory of its own.
        with self.run.meter.excluded(), preserved_random_states(), torch.no_grad():
            model.eval()
            try:
                metrics = evaluate(model, step)
            finally:
                for module, mode in modes.items():
                    module.training = mode
        if metrics:
            seconds = {**self.run.progress.stage_seconds, self.name: self.clock.seconds}
            self.run.run_log.write(self.trainer.index, step, metrics=dict(metrics), train_s=sum(seconds.values()))

    def _log_step(self, record: StepRecord) -> None:
        for task, said in record.said:
            self.run.run_log.write(record.stage, record.step, task=task, **({"said": said} if said else {}))
            if said:
                self._bar.say(f"step {record.step:,}, {task}: {said}")
        if record.step not in (1, record.iterations) and record.step % self.run.ppl.log_every and not record.scalars:
            return
        groups = self.trainer.optimizer.groups.values()
        facts = {"lr": {group.name: group.lr for group in groups}, **self.trainer.model.counts()}
        self._unread.append((record, facts))
        if self.trainer.device.type == "cpu" or len(self._unread) >= UNREAD_LINES:
            self._write_lines()

    def _write_lines(self) -> None:
        if not self._unread:
            return
        tensors = [x for r, _ in self._unread for x in (r.total, *r.parts.values(), *r.scalars.values())]
        values = iter(read_scalars(tensors))
        for record, facts in self._unread:
            line: dict[str, Any] = {"view": record.view, "loss": next(values)}
            line["parts"] = {name: next(values) for name in record.parts}
            if record.seconds:
                line["seconds"] = {name: round(seconds, 6) for name, seconds in record.seconds.items()}
            if record.scalars:
                line["scalars"] = {name: next(values) for name in record.scalars}
            self.run.run_log.write(record.stage, record.step, **line, **facts)
        self._unread.clear()
