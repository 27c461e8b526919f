"""Training inside a run directory: resumed, shared between rate points, and starting from trained scenes."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from splatwizard_core.base.block import Block
from splatwizard_core.base.files import sweep, write_atomic
from splatwizard_core.base.lock import directory_lock, is_held
from splatwizard_core.errors import SplatwizardError
from splatwizard_core.evaluation.evaluate import evaluate, kept_header, raster_header
from splatwizard_core.evaluation.metrics import quick_metrics
from splatwizard_core.gaussians.placement import placed_in
from splatwizard_core.gaussians.splat_model import SplatModel
from splatwizard_core.plugins import Entry
from splatwizard_core.plugins.versions import changes, made_by
from splatwizard_core.runs import pretrained
from splatwizard_core.runs.config import ResolvedConfig
from splatwizard_core.runs.directory import CHECKPOINTS, LOG, RunRequest, StepLog, run_directory
from splatwizard_core.runs.facts import TrainingFacts, contention
from splatwizard_core.runs.identity import stored_beside, stored_key, training_identity, training_key
from splatwizard_core.runs.observers import StartedTraining, watched_by
from splatwizard_core.runs.phases import StageParts
from splatwizard_core.runs.record import PretrainingBlock, StageBlock
from splatwizard_core.runs.session import Session, TrainedModel
from splatwizard_core.scene.images import decode_all
from splatwizard_core.streams import stream
from splatwizard_core.training.checkpoint import CheckpointStore
from splatwizard_core.training.measurements import LoopFigures
from splatwizard_core.training.pipeline import TrainingRun
from splatwizard_native import CoreTime

STEP = "train"
BEGUN = "begun"
CACHE = ".trained"  # inside the output root: a scene that is trained for a run stays with the runs


def train(session: Session, request: RunRequest, directory: Path, *, stop_after: int | None = None) -> TrainedModel:
    """Return the trained model of this configuration on this scene, from wherever it already exists.

    request     with `resume` False neither a checkpoint nor another directory's training is used, only what this
                session trained
    directory   run directory, held by the caller; another rate point's beside it is used if it was trained equally, and
                a scene that was trained for others to start from
    stop_after  end the process's part of the training after this many steps (raises KeyboardInterrupt then)
    """
    resolved = request.resolved
    key = training_key(session, resolved)
    found = session.kept("trained", key)
    if found is None:
        # Starting again takes nothing old, least of all from a neighbour that the same command is about to clear.
        home = (finished_directory(session, request, directory) if request.resume else None) or directory
        found = _trained_in(home, session, request, key, stop_after)
        session.keep("trained", found)
        if home != directory and home.parent.name == CACHE and not (directory / LOG).exists():
            write_atomic(directory / LOG, (home / LOG).read_text("utf-8"))  # reports look for it here
    steps = StepLog(directory)
    if steps.done(STEP, key, TrainingFacts) is None and _finished(session, directory, key) is None:
        # It uses the training of another directory, which is noted in this one.
        other = found.facts.trained_in
        made = "that others started from" if other == resolved.rate else f"of {other}"
        session.say(f"rate point {resolved.rate} shares the training {made}")
        steps.finish(STEP, key, found.facts.model_copy(update={"checkpoints": "elsewhere"}))
    return found


def _trained_in(home: Path, session: Session, request: RunRequest, key: str, stop_after: int | None) -> TrainedModel:
    """Train in the directory `home`, or load what is finished there."""
    resolved, plugins = request.resolved, session.plugins
    steps, done = StepLog(home), _finished(session, home, key)
    if done is None:
        scene = session.scene(resolved)
        own = pretrained.own_start(resolved)
        start = f", from {own} in place of the scene's points" if own else ""
        session.say(f"training {resolved.method} on {scene.name} ({resolved.preset} preset, {session.device}){start}")
        if not CheckpointStore(home / CHECKPOINTS).paths():  # those of another training are refused, and stay as is
            steps.finish(BEGUN, key, Block())  # whoever wants the same scene meanwhile may wait for it
    request = replace(request, resume=request.resume or done is not None)
    with plugins.recording() as loaded:
        model, facts = _train_stages(session, request, home, loaded, stop_after, watched=done is None)
    if done is None:
        steps.finish(STEP, key, facts)
        return TrainedModel(model, key, facts)
    changed = changes(plugins, done.made_by)
    if changed:
        session.say(f"{home} was trained with {', '.join(changed)}; it is used as it is (--fresh trains again)")
    return TrainedModel(model, key, done)  # with what was measured when it was trained, not when it was loaded


def trained_scene(session: Session, name: str, outer: ResolvedConfig, out: Path) -> TrainedModel:
    """Return the trained scene of method `name`, frozen: the file that `outer` names, from an ordinary run under `out`,
    from the cache, or trained now.

    Two processes that want the same one train it once: the second waits for the first.
    """
    if outer.init and name == pretrained.first_scene(pretrained.make_method(session.plugins, outer)):
        session.say_once(f"{outer.method} starts from {outer.init} in place of a trained {name} scene")
        return session.once(("model", outer.init), lambda: _scene_of_file(session, Path(outer.init), outer))
    resolved = pretrained.base_config(session.plugins, name, outer)
    key = training_key(session, resolved)
    kept = session.kept("start", key)
    if kept is not None:
        return kept
    request, cached = RunRequest(resolved, out), cached_directory(session, resolved, out)
    homes = [*_folders(run_directory(request).parent), cached]
    begun = (each for each in homes if StepLog(each).done(BEGUN, key, Block) is not None and is_held(each))
    directory = _first_finished(session, homes, key) or next(begun, cached)
    with directory_lock(directory, wait=True, say=session.say):
        sweep(directory)
        if _finished(session, directory, key) is not None:
            session.say_once(f"{outer.method} starts from the trained {name} scene in {directory}")
        elif CheckpointStore(directory / CHECKPOINTS).paths():
            session.say(f"the trained {name} scene for this configuration is not finished yet: going on with it first")
        else:
            session.say(f"no trained {name} scene for this configuration yet: training it first")
        found = train(session, request, directory)
    found.model.eval().requires_grad_(False)
    session.keep("start", found)
    return found


def _scene_of_file(session: Session, path: Path, outer: ResolvedConfig) -> TrainedModel:
    """Return the explicit Gaussians of a .ply as a trained scene, frozen. Nobody knows how it was trained."""
    digest = session.file_digest(path)
    found = placed_in(pretrained.check_model(str(path)), session.scene(outer), path.name)
    model = found.to(session.device).eval().requires_grad_(False)
    return TrainedModel(model, digest, TrainingFacts(file={"name": path.name, "sha256": digest}))


def cached_directory(session: Session, resolved: ResolvedConfig, out: Path) -> Path:
    """Return where the trained scene of a configuration is kept for those that start from it.

    The folder is named by the key; one that another release named is found by what its checkpoint says.
    """
    key = training_key(session, resolved)
    folder, name = out / CACHE, f"{session.scene(resolved).name}-{resolved.method}-"
    found = folder / f"{name}{key[:16]}"
    if not found.exists():
        for each in (each for each in _folders(folder) if re.fullmatch(r"[0-9a-f]{16}", each.name.removeprefix(name))):
            stored = CheckpointStore(each / CHECKPOINTS).identity()
            if stored is not None and stored_key(session.plugins, stored) == key:
                return each
    return found


def finished_directory(session: Session, request: RunRequest, directory: Path) -> Path | None:
    """Find the directory with the finished training of a request: `directory`, that of a rate point beside, or the
    cache's."""
    cached = cached_directory(session, request.resolved, request.out)
    homes = [directory, *_folders(directory.parent), cached]
    return _first_finished(session, homes, training_key(session, request.resolved))


def _first_finished(session: Session, homes: Iterable[Path], key: str) -> Path | None:
    return next((each for each in homes if _finished(session, each, key) is not None), None)


def _finished(session: Session, directory: Path, key: str) -> TrainingFacts | None:
    """Return the facts of this training if a run directory holds it, finished, with its own checkpoints.

    Of another release it has another key there, and is known by what its checkpoint says.
    """
    under = StepLog(directory).key_of(STEP)
    if under is None or not CheckpointStore(directory / CHECKPOINTS).paths():
        return None
    facts = StepLog(directory).done(STEP, under, TrainingFacts)
    if facts is None or facts.checkpoints:
        return None

    def today() -> str | None:
        stored = CheckpointStore(directory / CHECKPOINTS).identity()
        return None if stored is None else stored_key(session.plugins, stored, finished_as=under)

    return facts if key == under or session.once(("key", directory, under), today) == key else None


def _folders(parent: Path) -> list[Path]:
    return sorted(each for each in parent.iterdir() if each.is_dir()) if parent.is_dir() else []


def _train_stages(
    session: Session, request: RunRequest, directory: Path, loaded: list[Entry], stop_after: int | None, *,
    watched: bool,
) -> tuple[SplatModel, TrainingFacts]:  # fmt: skip
    """Train the stages of a method in a directory, or load what its checkpoints say is finished.

    loaded      entries that the registries are asked for meanwhile, as it grows
    watched     plugins may watch it; False: it is only loaded

    Returns the model and the facts that are reported of its training.
    """
    resolved, plugins = request.resolved, session.plugins
    scene, ppl = session.scene(resolved), resolved.ppl
    method = pretrained.make_method(plugins, resolved)
    stages = pretrained.planned_stages(plugins, resolved)
    rasterizer = session.rasterizer(resolved, [name for stage in stages for name in stage.prefer])
    options = rasterizer.decided(stages[-1].raster_options(stages[-1].iterations, scene.background))
    parts = StageParts(plugins, stages, ppl, loaded, rasterizer)
    before: dict[str, PretrainingBlock] = {}

    def frozen(name: str) -> SplatModel:
        """Return the trained scene that a stage starts from or is taught by."""
        if name not in pretrained.named_scenes(method):
            raise SplatwizardError(
                f"a stage of '{resolved.method}' asks for a trained '{name}' scene, which no stage names in "
                "`starts_from` or `taught_by`: its training could not be told from one with another such scene"
            )
        with parts.elsewhere():
            source = trained_scene(session, name, resolved, request.out)
        base = pretrained.base_config(plugins, name, resolved)
        before[name] = source.facts.as_start(base.preset, base.config.model_dump(mode="json"))
        return source.model

    def test_metrics(model: SplatModel, step: int) -> dict[str, float]:
        """Return the metrics of the test views that the log keeps on the way."""
        result = evaluate(
            model, scene.test, rasterizer, plugins,
            device=session.device, options=replace(options, background=scene.background),
            metrics=quick_metrics(plugins.metrics), label=f"evaluate at step {step:,}",
        )  # fmt: skip
        return {name: metric.mean for name, metric in result.metrics.items() if metric.mean is not None}

    identity = training_identity(session, resolved)
    if ppl.eval_every:
        decode_all(scene.test)  # here, so that they do not count as memory of the training
    started = StartedTraining(resolved.method, directory, scene, rasterizer, ppl.log)
    watching = plugins.hook.run_started(training=started) if watched else []
    cores = CoreTime()
    with watched_by(watching, plugins, session.say) as after_step:
        outcome = TrainingRun(
            stages,
            lambda: method.create_model(scene, stream(ppl.seed, "init")).to(session.device),
            scene, ppl, rasterizer,
            directory=directory / CHECKPOINTS, identity=identity, trained=frozen, stop_after=stop_after,
            resume=request.resume, allow_changed_plan=request.allow_changed_plan, on_step=after_step,
            read_identity=lambda stored: stored_beside(plugins, stored, identity),
            evaluate=test_metrics, log_path=directory / LOG, provided=parts.since_asked, say=session.say,
        ).train()  # fmt: skip
    figures, rasterizers = outcome.figures, plugins.rasterizers
    served = [rasterizers.entry(name) for name in figures.rasterizers.values() if name in rasterizers]
    return outcome.model, TrainingFacts(
        **dict(LoopFigures.model_validate(figures.model_dump())), train_s=figures.train_s, steps=figures.steps,
        stages=[StageBlock(name=name, seconds=seconds) for name, seconds in figures.stage_seconds.items()],
        pretraining=before, trained_in=resolved.rate, plan=outcome.plan, rasterizers=figures.rasterizers,
        phases=parts.phases(figures.provided), made_by=made_by(plugins, [*loaded, *served]),
        raster=raster_header(options) if figures.steps else kept_header(outcome.model, options, ppl.raster.options),
        contended=contention("train", cores),
    )  # fmt: skip
