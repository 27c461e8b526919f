"""All training stages of a run, one after the other, resumed where an earlier process left off."""

from __future__ import annotations

import copy
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
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


@dataclass
class TrainOutcome:
    """A finished training, resumed processes included.

    model           what the last stage's `finish` returned
    stage_seconds   wall clock of each stage's loop, by stage name, without housekeeping
    train_s         their sum
    steps           over all stages
    peak_memory     bytes above what was there before (CPU: resident set; CUDA: allocator, absolute)
    stage_breakdown stage name -> seconds in pre, render, loss, backward, post, optimize; None: not profiled
    plan            of each stage: name, steps, and its tasks as printed
    rasterizers     features asked for -> who served them
    pictures_in     where the training pictures were: "host" or "cuda"
    provided        stage name -> what served it, as `train_stages(provided=...)` told
    """

    model: SplatModel
    stage_seconds: dict[str, float]
    train_s: float
    steps: int
    peak_memory: int
    stage_breakdown: dict[str, dict[str, float]] | None
    plan: list[dict[str, Any]]
    rasterizers: dict[str, str]
    pictures_in: str = "host"
    provided: dict[str, list[dict[str, str]]] = field(default_factory=dict)


@dataclass
class _Run:
    """What all stages of one run share."""

    stages: Sequence[Stage]
    create_model: Callable[[], SplatModel]
    scene: Scene
    ppl: PipelineParams
    rasterizer: Rasterizer
    identity: Mapping[str, Any]
    trained: Callable[[str], SplatModel]
    store: CheckpointStore | None
    allow_changed_plan: bool
    provided: Callable[[], list[dict[str, str]]]
    names: list[str] = field(init=False)

    def __post_init__(self) -> None:
        self.names = []
        for stage in self.stages:
            taken = self.names.count(stage.name)
            self.names.append(stage.name if not taken else f"{stage.name}-{len(self.names)}")

    def streams(self, index: int) -> Streams:
        """Those of a stage; a later stage does not repeat the draws of the first."""
        return Streams(self.ppl.seed, "" if index == 0 else f"{index}/")

    def begin(self, index: int, model: SplatModel | None, streams: Streams) -> SplatModel:
        """The model of a stage before its first step.

        model   as the stage before left it; None: this stage does not need one, or is the first
        """
        stage = self.stages[index]
        if stage.starts_from is not None:
            # The trained scene belongs to whoever made it, and other stages may be taught by it.
            model = copy.deepcopy(self.trained(stage.starts_from)).requires_grad_(True).train()
        elif model is None:
            model = self.create_model()
        return stage.begin(StageContext(model, self.scene, self.ppl, self.rasterizer, streams, self.trained))

    def trainer(self, index: int, model: SplatModel, streams: Streams, breakdown: dict[str, float] | None) -> Trainer:
        clock = StageClock(model.device, breakdown) if self.ppl.profile == "stages" else None
        return Trainer(
            self.stages[index], model, self.scene, self.ppl, self.rasterizer, streams, index=index, stage_clock=clock
        )

    def before(self, index: int) -> SplatModel | None:
        """The model that a stage begins with, rebuilt from the last checkpoints of the stages before it."""
        if index == 0 or self.stages[index].starts_from is not None:
            return None
        assert self.store is not None
        trainer = self.restore(self.store.last_of(index - 1))
        return trainer.stage.finish(trainer.model, self.scene)

    def restore(self, saved: Checkpoint) -> Trainer:
        """The trainer of a checkpoint's stage as it was after the checkpoint's step. Raises CheckpointError."""
        index = saved.stage
        if index >= len(self.stages):
            raise CheckpointError(f"the checkpoint is of stage {index}, this run has {len(self.stages)} stages")
        streams = self.streams(index)
        model = self.begin(index, self.before(index), streams)
        trainer = self.trainer(index, model, streams, saved.progress["breakdown"].get(self.names[index]))
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
        """What differs from what the checkpoint was made with; raises CheckpointError unless that is allowed."""
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
        """A stage's plan for the record."""
        stage = self.stages[index]
        pre, post = build_schedulers(stage, self.ppl)
        rows = plan_rows(pre.registrations, post.registrations, total=stage.iterations)
        return {"stage": self.names[index], "iterations": stage.iterations, "tasks": [row_facts(r) for r in rows]}

    def checkpoint(self, trainer: Trainer, progress: Progress, *, finished: bool) -> Checkpoint:
        return Checkpoint(
            trainer.index,
            trainer.stage.name,
            trainer.step,
            finished,
            normalised(self.identity),
            plan_of(trainer),
            self.scene.extent,
            progress.as_dict(),
            {**trainer.state_dict(), "rng": rng.capture()},
        )


def plan_of(trainer: Trainer) -> list[str]:
    """What identifies the plan of a stage."""
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
    run = _Run(stages, create_model, scene, ppl, rasterizer, identity, trained, store, allow_changed_plan, provided)
    if not resume:
        if store is not None:
            store.clear()
        run_log.clear()
    saved = store.newest() if store is not None else None
    progress = Progress() if saved is None else Progress(**saved.progress)
    meter = MemoryMeter("cpu")
    meter.start()
    trainer: Trainer | None = None
    model: SplatModel | None = None
    with rng.seeded(ppl.seed):
        if saved is None:
            run_log.clear()
        else:
            trainer = run.restore(saved)
            run_log.rewind(saved.stage, saved.step)
            provided()  # what began the stage is known from the process that began it
        plans = [run.describe(index) for index in range(0 if saved is None else saved.stage)]
        saved = None  # its tensors are as large as the model and its optimizer
        with run_log:
            for index in range(len(plans), len(stages)):
                if trainer is None:
                    streams = run.streams(index)
                    trainer = run.trainer(index, run.begin(index, model, streams), streams, None)
                if meter.kind == "rss" and trainer.device.type == "cuda":
                    meter = MemoryMeter(trainer.device)
                    meter.start()
                plans.append(run.describe(index))
                if not trainer.stopped:
                    _run_stage(run, trainer, progress, run_log, meter, stop_after, on_step, evaluate)
                model = trainer.stage.finish(trainer.model, scene)
                trainer = None
    assert model is not None
    seconds = progress.stage_seconds
    return TrainOutcome(
        model,
        dict(seconds),
        sum(seconds.values()),
        progress.steps,
        progress.peak_memory,
        progress.breakdown or None,
        plans,
        dict(progress.rasterizers),
        progress.pictures_in,
        {name: progress.provided.get(name, []) for name in run.names},
    )


def _run_stage(
    run: _Run,
    trainer: Trainer,
    progress: Progress,
    run_log: RunLog,
    meter: MemoryMeter,
    stop_after: int | None,
    on_step: OnStep | None,
    evaluate: Evaluate | None,
) -> None:
    """One stage to its end, with its last checkpoint. Raises TrainingStopped where the run is to stop."""
    index, iterations = trainer.index, trainer.stage.iterations
    name = run.names[index]
    before = progress.steps - progress.stage_steps.get(name, 0)
    until = iterations if stop_after is None else min(iterations, stop_after - before)

    def save(finished: bool) -> None:
        known = progress.provided.setdefault(name, [])
        known += [part for part in run.provided() if part not in known]
        if run.store is not None:
            run.store.write(run.checkpoint(trainer, progress, finished=finished))

    title = str(run.identity.get("method", name))
    label = f"train {title}" if len(run.stages) == 1 else f"train {title}: {name} ({index + 1} of {len(run.stages)})"
    housekeeping = Housekeeping(
        trainer, name, progress, run_log, save, meter, label=label, on_step=on_step, evaluate=evaluate
    )
    if until > trainer.step or stop_after is None:
        decode_all(run.scene.train)  # reading pictures is not training time
        progress.pictures_in = "cuda" if keep_pictures(run.scene.train, trainer.device) else "host"
        try:
            with housekeeping:
                trainer.run(until, housekeeping.after_step, housekeeping.guard)
        finally:
            keep_pictures(run.scene.train, "cpu")
    finished = trainer.stopped or trainer.step >= iterations
    housekeeping.save(finished=finished)
    last = finished and index == len(run.stages) - 1
    if stop_after is not None and before + trainer.step >= stop_after and not last:
        raise TrainingStopped(f"stopped after step {before + trainer.step}; run again to go on")
