"""All training stages of a run, one after the other, resumed where an earlier process left off."""

from __future__ import annotations

import copy
import functools
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from splatwizard_core.errors import CheckpointError
from splatwizard_core.gaussians.splat_model import SplatModel
from splatwizard_core.memory import MemoryMeter
from splatwizard_core.rendering.rasterizer import Rasterizer
from splatwizard_core.scene.images import decode_all, keep_pictures
from splatwizard_core.scene.scene import Scene
from splatwizard_core.training import rng
from splatwizard_core.training.checkpoint import Checkpoint, CheckpointStore, differences, normalised
from splatwizard_core.training.housekeeping import Evaluate, Housekeeping, OnStep, Progress
from splatwizard_core.training.params import PipelineParams
from splatwizard_core.training.plan import plan_rows, row_facts
from splatwizard_core.training.rng import Streams
from splatwizard_core.training.run_log import RunLog
from splatwizard_core.training.scheduler import build_schedulers
from splatwizard_core.training.stage import Stage, StageContext
from splatwizard_core.training.timing import StageClock
from splatwizard_core.training.trainer import Trainer

__all__ = ["TrainOutcome", "TrainingStopped", "train_stages"]

log = logging.getLogger(__name__)


class TrainingStopped(KeyboardInterrupt):
    """`stop_after` was reached and a checkpoint written: the run is to be resumed, its outcome does not exist yet."""


@dataclass(kw_only=True)
class TrainOutcome(Progress):
    """A finished training: its figures, of resumed processes too, and

    model   as the last stage's `finish` returned it
    plan    of each stage: name, steps, and its tasks as printed
    """

    model: SplatModel
    plan: list[dict[str, Any]]

    @property
    def train_s(self) -> float:
        """Seconds of all stages' loops, without housekeeping."""
        return sum(self.stage_seconds.values())


@dataclass
class _Run:
    """The parts that all stages of one run share, see `train_stages`."""

    stages: Sequence[Stage]
    create_model: Callable[[], SplatModel]
    scene: Scene
    ppl: PipelineParams
    rasterizer: Rasterizer
    identity: Mapping[str, Any]
    trained: Callable[[str], SplatModel]
    store: CheckpointStore | None
    run_log: RunLog
    stop_after: int | None
    allow_changed_plan: bool
    on_step: OnStep | None
    evaluate: Evaluate | None
    provided: Callable[[], list[dict[str, str]]]
    progress: Progress = field(default_factory=Progress)

    @property
    def names(self) -> list[str]:
        """Names of the stages, made unique."""
        names: list[str] = []
        for stage in self.stages:
            names.append(f"{stage.name}-{len(names)}" if stage.name in names else stage.name)
        return names

    def streams(self, index: int) -> Streams:
        """Return the streams of a stage; a later stage does not repeat the draws of the first."""
        return Streams(self.ppl.seed, "" if index == 0 else f"{index}/")

    def trainer(self, index: int, model: SplatModel | None) -> Trainer:
        """Return the trainer of a stage before its first step.

        model   as the stage before left it; None: this stage does not need one, or is the first
        """
        stage, streams = self.stages[index], self.streams(index)
        if stage.starts_from is not None:
            # A copy: the trained scene stays with the runner, and other stages may be taught by it.
            model = copy.deepcopy(self.trained(stage.starts_from)).requires_grad_(True).train()
        elif model is None:
            model = self.create_model()
        model = stage.begin(StageContext(model, self.scene, self.ppl, self.rasterizer, streams, self.trained))
        clock = None
        if self.ppl.profile == "stages":
            clock = StageClock(model.device, self.progress.breakdown.get(self.names[index]))
        return Trainer(stage, model, self.scene, self.ppl, self.rasterizer, streams, index=index, stage_clock=clock)

    def before(self, index: int) -> SplatModel | None:
        """Return the model that a stage begins with, rebuilt from the last checkpoints of the stages before it."""
        if index == 0 or self.stages[index].starts_from is not None:
            return None
        assert self.store is not None
        trainer = self.restore(self.store.last_of(index - 1))
        return trainer.stage.finish(trainer.model, self.scene)

    def restore(self, saved: Checkpoint) -> Trainer:
        """Return the trainer of a checkpoint's stage as it was after the checkpoint's step. Raises CheckpointError."""
        if saved.stage >= len(self.stages):
            raise CheckpointError(f"the checkpoint is of stage {saved.stage}, this run has {len(self.stages)} stages")
        trainer = self.trainer(saved.stage, self.before(saved.stage))
        changed = self._check(saved, trainer)
        try:
            trainer.load_state_dict(saved.state, saved.step)
        except (KeyError, ValueError, TypeError, AttributeError, RuntimeError) as error:
            raise CheckpointError(
                f"the checkpoint of stage '{saved.stage_name}', step {saved.step}, does not fit this run: {error}"
            ) from error
        # A stage that was finished under another plan may have steps left under this one.
        trainer.stopped = saved.finished and not changed
        rng.restore(saved.state["rng"])
        return trainer

    def _check(self, saved: Checkpoint, trainer: Trainer) -> list[str]:
        """Return what differs from what the checkpoint was made with; raise CheckpointError unless that is allowed."""
        changed = differences(saved, self.identity, plan_of(trainer), self.scene.extent)
        if changed and not self.allow_changed_plan:
            more = f" and {len(changed) - 3} more" if len(changed) > 3 else ""
            raise CheckpointError(
                f"the checkpoint of stage '{saved.stage_name}', step {saved.step}, was made by another plan or "
                f"configuration ({'; '.join(changed[:3])}{more}): resume with --allow-changed-plan, or use --fresh"
            )
        for line in changed:
            log.warning("resuming with a changed plan or configuration: %s", line)
        return changed

    def describe(self, index: int) -> dict[str, Any]:
        """Return a stage's plan for the record."""
        stage = self.stages[index]
        pre, post = build_schedulers(stage, self.ppl)
        rows = plan_rows(pre.registrations, post.registrations, total=stage.iterations)
        return {"stage": self.names[index], "iterations": stage.iterations, "tasks": [row_facts(r) for r in rows]}

    def save(self, trainer: Trainer, finished: bool) -> None:
        """Write a checkpoint of the trainer as it is."""
        known = self.progress.provided.setdefault(self.names[trainer.index], [])
        known += [part for part in self.provided() if part not in known]
        if self.store is not None:
            state = {**trainer.state_dict(), "rng": rng.capture()}
            self.store.write(
                Checkpoint(
                    trainer.index, trainer.stage.name, trainer.step, finished, normalised(self.identity),
                    plan_of(trainer), self.scene.extent, asdict(self.progress), state,
                )
            )  # fmt: skip

    def run_stage(self, trainer: Trainer, meter: MemoryMeter) -> None:
        """Train a stage to its end, with its last checkpoint. Raises TrainingStopped where the run is to stop."""
        index, iterations, name = trainer.index, trainer.stage.iterations, self.names[trainer.index]
        before = self.progress.steps - self.progress.stage_steps.get(name, 0)
        stop_after = self.stop_after
        until = iterations if stop_after is None else min(iterations, stop_after - before)
        label = f"train {self.identity.get('method', name)}"
        if len(self.stages) > 1:
            label += f": {name} ({index + 1} of {len(self.stages)})"
        housekeeping = Housekeeping(
            trainer, name, self.progress, self.run_log, functools.partial(self.save, trainer), meter,
            label=label, on_step=self.on_step, evaluate=self.evaluate,
        )  # fmt: skip
        if until > trainer.step or stop_after is None:
            decode_all(self.scene.train)  # reading pictures is not training time
            self.progress.pictures_in = "cuda" if keep_pictures(self.scene.train, trainer.device) else "host"
            try:
                with housekeeping:
                    trainer.run(until, housekeeping.after_step, housekeeping.guard)
            finally:
                keep_pictures(self.scene.train, "cpu")
        finished = trainer.stopped or trainer.step >= iterations
        housekeeping.save(finished=finished)
        done, last = before + trainer.step, finished and index == len(self.stages) - 1
        if stop_after is not None and done >= stop_after and not last:
            raise TrainingStopped(f"stopped after step {done}; run again to go on")


def plan_of(trainer: Trainer) -> list[str]:
    """Return what identifies the plan of a stage."""
    return [*trainer.pre.plan_lines(), *trainer.post.plan_lines()]


def train_stages(
    stages: Sequence[Stage],
    create_model: Callable[[], SplatModel],
    scene: Scene,
    ppl: PipelineParams,
    rasterizer: Rasterizer,
    *,
    directory: Path | None,
    identity: Mapping[str, Any],
    trained: Callable[[str], SplatModel],
    stop_after: int | None = None,
    resume: bool = True,
    allow_changed_plan: bool = False,
    on_step: OnStep | None = None,
    evaluate: Evaluate | None = None,
    log_path: Path | None = None,
    provided: Callable[[], list[dict[str, str]]] = list,
) -> TrainOutcome:
    """Train all stages, or what an earlier process has left of them; a run that is finished is only loaded.

    create_model    () -> the model before the first step, on the device that trains it
    directory       where checkpoints are written and looked for; None: nothing is kept
    identity        what the result depends on besides the plan (method, version, resolved configuration), JSON-able;
                    a checkpoint of another identity is refused
    trained         (method name) -> a frozen, trained model of this scene
    stop_after      stop after this step, counted over all stages: a checkpoint is written and TrainingStopped raised
    resume          go on from the newest checkpoint; False: remove what the directory holds and start again
    allow_changed_plan  go on although plan or identity differ; the differences are logged
    on_step         (model, record), called after each step; its time and its random draws are not the training's
    evaluate        (model, step of the stage) -> metrics for the log, every `ppl.eval_every` steps, without gradient,
                    in eval mode, with the process-wide random states kept
    log_path        of log.jsonl; default: in `directory`
    provided        () -> what served (rasterizers, pruners, ...) since it was last asked: kept by stage

    A Ctrl-C is answered after the step with a checkpoint of it, then KeyboardInterrupt. On a CPU, stopping and
    resuming gives bit for bit what an uninterrupted run gives.
    Raises NothingToDo if a checkpoint lies at or past the end of a stage that it did not finish; CheckpointError,
    TrainingDiverged, EmptyModel, TaskError.
    """
    if not stages:
        raise ValueError("a training needs at least one stage")
    if log_path is None and directory is not None:
        log_path = directory / "log.jsonl"
    store = None if directory is None else CheckpointStore(directory, ppl.keep_checkpoints)
    run_log = RunLog(log_path)
    run = _Run(
        stages, create_model, scene, ppl, rasterizer, identity, trained, store, run_log, stop_after,
        allow_changed_plan, on_step, evaluate, provided,
    )  # fmt: skip
    if not resume and store is not None:
        store.clear()
    saved = store.newest() if store is not None else None
    meter = MemoryMeter("cpu")
    meter.start()
    trainer: Trainer | None = None
    model: SplatModel | None = None
    with rng.seeded(ppl.seed):
        if saved is None:
            run_log.clear()
        else:
            run.progress = Progress(**saved.progress)
            trainer = run.restore(saved)
            run_log.rewind(saved.stage, saved.step)
            provided()  # what began the stage is known from the process that began it
        plans = [run.describe(index) for index in range(0 if saved is None else saved.stage)]
        saved = None  # its tensors are as large as the model and its optimizer
        with run_log:
            for index in range(len(plans), len(stages)):
                trainer = trainer or run.trainer(index, model)
                if meter.kind == "rss" and trainer.device.type == "cuda":
                    meter = MemoryMeter(trainer.device)
                    meter.start()
                plans.append(run.describe(index))
                if not trainer.stopped:
                    run.run_stage(trainer, meter)
                model = trainer.stage.finish(trainer.model, scene)
                trainer = None
    assert model is not None
    run.progress.provided = {name: run.progress.provided.get(name, []) for name in run.names}
    return TrainOutcome(**vars(run.progress), model=model, plan=plans)
