"""Runs all training stages in order, resuming from checkpoints of an earlier process."""

from __future__ import annotations

import copy
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Any

import torch

from splatwizard_core.base.memory import MemoryMeter
from splatwizard_core.base.random_states import seeded
from splatwizard_core.base.run_log import RunLog
from splatwizard_core.errors import CheckpointError, ConfigError
from splatwizard_core.gaussians.splat_model import SplatModel
from splatwizard_core.rendering.features import Feature
from splatwizard_core.rendering.rasterizer import Rasterizer
from splatwizard_core.scene.images import decode_all, keep_pictures
from splatwizard_core.scene.scene import Scene
from splatwizard_core.streams import Streams
from splatwizard_core.training.checkpoint import (
    Checkpoint,
    CheckpointStore,
    DamagedCheckpointError,
    differences,
    normalised,
)
from splatwizard_core.training.housekeeping import Evaluate, Housekeeping, OnStep
from splatwizard_core.training.measurements import Provided, StagePlan, TrainingFigures
from splatwizard_core.training.params import PipelineParams
from splatwizard_core.training.plan import plan_rows
from splatwizard_core.training.scheduler import build_schedulers
from splatwizard_core.training.stage import Stage, StageContext
from splatwizard_core.training.state import TrainingState
from splatwizard_core.training.timing import StageClock
from splatwizard_core.training.trainer import Trainer

log = logging.getLogger(__name__)


class TrainingStopped(KeyboardInterrupt):
    """`stop_after` was reached and a checkpoint written: the run is to be resumed, its outcome does not exist yet."""


@dataclass(frozen=True)
class TrainOutcome:
    """A finished training: the model as the last stage's `finish` returned it, figures and plan of all stages."""

    model: SplatModel
    figures: TrainingFigures
    plan: list[StagePlan]


@dataclass
class TrainingRun:
    """All stages of a run: `train` trains them, or what an earlier process has left; a finished run is only loaded.

    create_model    () -> the model before the first step, on the device that trains it
    directory       where checkpoints are written and looked for; None: nothing is kept
    identity        what the result depends on besides the plan (method, version, resolved configuration), JSON-able;
                    a checkpoint of another identity is refused
    read_identity   identity in a checkpoint of any release -> the same as `identity` would say it
    trained         (method name) -> a frozen, trained model of this scene
    stop_after      stop after this step, counted over all stages: a checkpoint is written and TrainingStopped raised
    resume          go on from the newest checkpoint; False: remove what the directory holds and start again
    allow_changed_plan  go on although plan or identity differ; the differences are logged
    on_step         (model, record), called after each step; its time and its random draws are not the training's
    evaluate        (model, step of the stage) -> metrics for the log, every `ppl.eval_every` steps, without gradient,
                    in eval mode, with the process-wide random states kept
    log_path        of log.jsonl; default: in `directory`
    provided        () -> what served (rasterizers, pruners, ...) since it was last asked: kept by stage
    say             is told from which step a resumed training goes on
    """

    stages: Sequence[Stage]
    create_model: Callable[[], SplatModel]
    scene: Scene
    ppl: PipelineParams
    rasterizer: Rasterizer
    _: KW_ONLY
    directory: Path | None
    identity: Mapping[str, Any]
    trained: Callable[[str], SplatModel]
    read_identity: Callable[[Mapping[str, Any]], Mapping[str, Any]] = dict
    stop_after: int | None = None
    resume: bool = True
    allow_changed_plan: bool = False
    on_step: OnStep | None = None
    evaluate: Evaluate | None = None
    log_path: Path | None = None
    provided: Callable[[], list[Provided]] = list
    say: Callable[[str], None] = log.info

    def __post_init__(self) -> None:
        if not self.stages:
            raise ValueError("a training needs at least one stage")
        if self.ppl.random_background and self.scene.protocol.composite8:
            raise ConfigError("random_background needs the alpha that legacy_8bit_composite removes: leave out one")
        self.store = None if self.directory is None else CheckpointStore(self.directory, self.ppl.keep_checkpoints)
        if self.log_path is None and self.directory is not None:
            self.log_path = self.directory / "log.jsonl"
        self.run_log = RunLog(self.log_path)
        self.figures = TrainingFigures()
        self.meter = MemoryMeter("cpu")
        self.names: list[str] = []  # of the stages, made unique
        for stage in self.stages:
            self.names.append(f"{stage.name}-{len(self.names)}" if stage.name in self.names else stage.name)

    def train(self) -> TrainOutcome:
        """Train all stages.

        A Ctrl-C is answered after the step with a checkpoint of it, then KeyboardInterrupt. On a CPU, stopping and
        resuming gives bit for bit what an uninterrupted run gives.
        Raises NothingToDo if a checkpoint lies at or past the end of a stage that it did not finish; CheckpointError,
        TrainingDiverged, EmptyModel, TaskError.
        """
        if self.store is not None and not self.resume:
            self.store.clear()
        self.meter.start()
        model: SplatModel | None = None
        first = 0
        with seeded(self.ppl.seed, deterministic=self.ppl.deterministic):
            trainer = None if self.store is None else self.store.restored(self._resumed)
            if trainer is None:
                self.run_log.clear()
            else:
                first, state = trainer.state.index, trainer.state
                if not state.stopped:
                    where = f" of stage '{state.name}'" if len(self.stages) > 1 else ""
                    self.say(f"going on after step {state.step:,} of {state.iterations:,}{where}")
                self.run_log.rewind(first, state.step)
                self.provided()  # what began the stage is known from the process that began it
            for index in range(first, len(self.stages)):
                trainer = trainer or self._trainer(index, model)
                if self.meter.kind == "rss" and trainer.device.type == "cuda":
                    self.meter = MemoryMeter(trainer.device)
                    self.meter.start()
                if not trainer.state.stopped:
                    self._run_stage(trainer)
                model = trainer.state.stage.finish(trainer.state.model, self.scene)
                trainer = None
        assert model is not None
        model.check_finite()
        self.figures.provided = {name: self.figures.provided.get(name, []) for name in self.names}
        plan = [self._describe(stage, name) for stage, name in zip(self.stages, self.names, strict=True)]
        return TrainOutcome(model, self.figures, plan)

    def _trainer(self, index: int, model: SplatModel | None) -> Trainer:
        """Return the trainer of a stage before its first step.

        model   as the stage before left it; None: this stage does not need one, or is the first
        """
        stage = self.stages[index]
        streams = Streams(self.ppl.seed, f"{index}/" if index else "")  # none repeats the draws of the first stage
        if stage.starts_from is not None:
            # A copy: the trained scene stays with the runner, and other stages may be taught by it.
            model = copy.deepcopy(self.trained(stage.starts_from)).requires_grad_(True).train()
        elif model is None:
            model = self.create_model()
        self._check_order_of_sums(model.device)
        model = stage.begin(StageContext(model, self.scene, self.ppl, self.rasterizer, streams, self.trained))
        name, clock = self.names[index], None
        if self.ppl.profile == "stages":
            clock = StageClock(model.device, (self.figures.breakdown_s or {}).get(name))
        state = TrainingState.begin(
            stage, model, self.scene, self.ppl, self.rasterizer, streams,
            index=index, name=name, figures=self.figures,
        )  # fmt: skip
        return Trainer(state, clock)

    def _check_order_of_sums(self, device: torch.device) -> None:
        """Raise ConfigError where equal bits are asked for, and no rasterizer of this run gives them."""
        if not self.ppl.deterministic:
            return
        info = self.rasterizer.info.on(device.type)
        if Feature.DETERMINISTIC.names - info.features:
            raise ConfigError(
                f"deterministic=true: rasterizer '{info.name}' sums in any order on {device.type} (it does not declare "
                "DETERMINISTIC); `sw list-plugins` shows which one does",
                key="deterministic",
            )

    def _before(self, index: int) -> SplatModel | None:
        """Return the model that a stage begins with, rebuilt from the last checkpoints of the stages before it."""
        if index == 0 or self.stages[index].starts_from is not None:
            return None
        assert self.store is not None
        try:
            state = self._restore(self.store.last_of(index - 1)).state
        except DamagedCheckpointError as error:  # no fault of the checkpoint that goes on from it
            raise CheckpointError(f"{error}; start again (--fresh)") from error
        return state.stage.finish(state.model, self.scene)

    def _resumed(self, saved: Checkpoint) -> Trainer:
        """Restore a trainer, and continue its clock from the accumulated numbers."""
        self.figures = saved.progress
        return self._restore(saved)

    def _restore(self, saved: Checkpoint) -> Trainer:
        """Return the trainer of a checkpoint's stage as it was after the checkpoint's step. Raises CheckpointError."""
        if saved.stage >= len(self.stages):
            raise CheckpointError(f"the checkpoint is of stage {saved.stage}, this run has {len(self.stages)} stages")
        trainer = self._trainer(saved.stage, self._before(saved.stage))
        where = f"the checkpoint of stage '{saved.stage_name}', step {saved.step},"
        told = saved.model_copy(update={"identity": normalised(self.read_identity(saved.identity))})
        changed = differences(told, self.identity, trainer.state.plan_lines(), self.scene.extent)
        if changed and not self.allow_changed_plan:
            more = f" and {len(changed) - 3} more" if len(changed) > 3 else ""
            raise CheckpointError(
                f"{where} was made by another plan or configuration ({'; '.join(changed[:3])}{more}): "
                "give another --out, use --fresh, or resume all the same with --allow-changed-plan"
            )
        for line in changed:
            log.warning("resuming with a changed plan or configuration: %s", line)
        try:
            trainer.state.load_state_dict(saved.state, saved.step)
        except torch.OutOfMemoryError:
            raise
        except Exception as error:  # whatever a part of the state raises that is not what it wrote
            # Of the very same plan and configuration, it is not what was written: the one before may be.
            kind = CheckpointError if changed else DamagedCheckpointError
            raise kind(f"{where} does not fit this run: {type(error).__name__}: {error}") from error
        # A stage that was finished under another plan may have steps left under this one.
        trainer.state.stopped = saved.finished and not changed
        return trainer

    def _describe(self, stage: Stage, name: str) -> StagePlan:
        """Return a stage's plan for the record."""
        pre, post = build_schedulers(stage, self.ppl)
        tasks = plan_rows(pre.registrations, post.registrations, total=stage.iterations)
        looked_up = stage.looked_up(self.scene)
        return StagePlan(stage=name, iterations=stage.iterations, tasks=tasks, looked_up=looked_up)

    def _run_stage(self, trainer: Trainer) -> None:
        """Train a stage to its end and write its last checkpoint. Raises TrainingStopped at `stop_after`."""
        state, stop_after = trainer.state, self.stop_after
        before = self.figures.steps - self.figures.stage_steps.get(state.name, 0)
        until = state.iterations if stop_after is None else min(state.iterations, stop_after - before)
        housekeeping = Housekeeping(self, trainer)
        trains = state.iterations and (until > state.step or stop_after is None)  # one that only encodes has no steps
        if trains:
            decode_all(self.scene.train)  # reading pictures is not training time
            self.figures.pictures_in = "cuda" if keep_pictures(self.scene.train, state.device) else "host"
        # A Ctrl-C waits for the end of its step, and one after the last step until that is saved.
        with housekeeping.guard:
            if trains:
                try:
                    with state.stage.running(state), housekeeping.around():
                        trainer.run(until, housekeeping.after_step)
                finally:
                    keep_pictures(self.scene.train, "cpu")
            housekeeping.save()
        done, last = before + state.step, state.finished and state.index == len(self.stages) - 1
        if stop_after is not None and done >= stop_after and not last:
            raise TrainingStopped(f"stopped after step {done}; run again to go on")
