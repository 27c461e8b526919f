"""Training inside a run directory: resumed, shared between rate points, and starting from trained scenes."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from splatwizard_core.errors import SplatwizardError
from splatwizard_core.evaluation.evaluate import evaluate, raster_header
from splatwizard_core.evaluation.metrics import quick_metrics
from splatwizard_core.files import sweep, write_atomic
from splatwizard_core.gaussians.splat_model import SplatModel
from splatwizard_core.method import Method
from splatwizard_core.native.core_time import CoreTime
from splatwizard_core.plugins import Entry
from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.runs import pretrained
from splatwizard_core.runs.config import ResolvedConfig
from splatwizard_core.runs.contention import contention
from splatwizard_core.runs.directory import CHECKPOINTS, LOG, RunRequest, StepLog
from splatwizard_core.runs.lock import directory_lock, is_held
from splatwizard_core.runs.observers import StartedTraining, watched_by
from splatwizard_core.runs.phases import StageParts
from splatwizard_core.runs.record import PretrainingBlock, TrainBlock, picked
from splatwizard_core.runs.session import Session, TrainedModel
from splatwizard_core.runs.versions import changes, made_by
from splatwizard_core.scene.images import decode_all
from splatwizard_core.streams import stream
from splatwizard_core.training.checkpoint import CheckpointStore
from splatwizard_core.training.pipeline import TrainingRun, TrainOutcome

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
    key = pretrained.training_key(session, resolved)
    found = session.kept("trained", key)
    if found is None:
        # Starting again takes nothing old, least of all from a neighbour that the same command is about to clear.
        home = (finished_directory(session, request, directory) if request.resume else None) or directory
        found = _trained_in(home, session, request, key, stop_after)
        session.keep("trained", found)
        if home != directory and home.parent.name == CACHE and not (directory / LOG).exists():
            write_atomic(directory / LOG, (home / LOG).read_text("utf-8"))  # reports look for it here
    steps = StepLog(directory)
    if steps.done(STEP, key) is None:  # then it uses the training of another directory, which is noted in this one
        other = found.facts.get("trained_in")
        made = "that others started from" if other == resolved.rate else f"of {other}"
        session.say(f"rate point {resolved.rate} shares the training {made}")
        steps.finish(STEP, key, {**found.facts, "checkpoints": "elsewhere"})
    return found


def _trained_in(home: Path, session: Session, request: RunRequest, key: str, stop_after: int | None) -> TrainedModel:
    """Train in the directory `home`, or load what is finished there."""
    resolved, plugins = request.resolved, session.plugins
    steps, done = StepLog(home), finished_training(home, key)
    resume = done is not None or (request.resume and not _is_of_an_older_release(session, home))
    if done is None:
        scene = session.scene(resolved)
        session.say(f"training {resolved.method} on {scene.name} ({resolved.preset} preset, {session.device})")
        if not CheckpointStore(home / CHECKPOINTS).paths():  # those of another training are refused, and stay as is
            steps.finish(BEGUN, key, {})  # whoever wants the same scene meanwhile may wait for it
    with plugins.recording() as loaded:
        training = _StagesOfARun(session, replace(request, resume=resume), home, loaded)
        model, facts = training.train(stop_after=stop_after, watched=done is None)
    if done is None:
        rasterizers = plugins.rasterizers
        served = [rasterizers.entry(name) for name in facts["rasterizers"].values() if name in rasterizers]
        facts |= {"made_by": made_by(plugins, [*loaded, *served]), "trained_in": resolved.rate}
        steps.finish(STEP, key, facts)
        return TrainedModel(model, key, facts)
    changed = changes(plugins, done.get("made_by"))
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
        return _scene_of_file(session, Path(outer.init))
    resolved = pretrained.base_config(session.plugins, name, outer)
    key = pretrained.training_key(session, resolved)
    kept = session.kept("start", key)
    if kept is not None:
        return kept
    ordinary = _ordinary_run(out / session.scene(resolved).name / name, key)
    directory = ordinary or cached_directory(session, resolved, out)
    with directory_lock(directory, wait=True, say=session.say):
        sweep(directory)
        if StepLog(directory).done(STEP, key) is not None:
            session.say_once(f"{outer.method} starts from the trained {name} scene in {directory}")
        elif CheckpointStore(directory / CHECKPOINTS).paths():
            session.say(f"the trained {name} scene for this configuration is not finished yet: going on with it first")
        else:
            session.say(f"no trained {name} scene for this configuration yet: training it first")
        found = train(session, RunRequest(resolved, out), directory)
    found.model.eval().requires_grad_(False)
    session.keep("start", found)
    return found


def _scene_of_file(session: Session, path: Path) -> TrainedModel:
    """Return the explicit Gaussians of a .ply as a trained scene, frozen. Nobody knows how it was trained."""
    digest = session.file_digest(path)
    found = session.kept("file", digest)
    if found is None:
        model = pretrained.check_model(str(path)).to(session.device).eval().requires_grad_(False)
        found = TrainedModel(model, digest, {"train_s": None, "file": {"name": path.name, "sha256": digest}})
        session.keep("file", found)
    return found


def cached_directory(session: Session, resolved: ResolvedConfig, out: Path) -> Path:
    """Return where the trained scene of a configuration is kept for those that start from it."""
    key = pretrained.training_key(session, resolved)
    return out / CACHE / f"{session.scene(resolved).name}-{resolved.method}-{key[:16]}"


def _ordinary_run(parent: Path, key: str) -> Path | None:
    """Find a run directory that holds this training, finished; else one in which another process is making it now."""
    directories = _folders(parent)
    finished = (each for each in directories if finished_training(each, key) is not None)
    begun = (each for each in directories if StepLog(each).done(BEGUN, key) is not None and is_held(each))
    return next(itertools.chain(finished, begun), None)


def finished_directory(session: Session, request: RunRequest, directory: Path) -> Path | None:
    """Find the directory with the finished training of a request: `directory`, that of a rate point beside, or the
    cache's."""
    key = pretrained.training_key(session, request.resolved)
    cached = cached_directory(session, request.resolved, request.out)
    candidates = dict.fromkeys([directory, *_folders(directory.parent), cached])
    return next((each for each in candidates if finished_training(each, key) is not None), None)


def finished_training(directory: Path, key: str) -> dict[str, Any] | None:
    """Return the facts of this training if a run directory holds it, finished, with its own checkpoints."""
    facts = StepLog(directory).done(STEP, key)
    if facts is None or "checkpoints" in facts or not CheckpointStore(directory / CHECKPOINTS).paths():
        return None
    return facts


def _folders(parent: Path) -> list[Path]:
    return sorted(each for each in parent.iterdir() if each.is_dir()) if parent.is_dir() else []


def _is_of_an_older_release(session: Session, directory: Path) -> bool:
    """Whether the checkpoints of a directory do not say all that they were made from; told, since they go then."""
    identity = CheckpointStore(directory / CHECKPOINTS).identity()
    if identity is None or identity.get("identity") == pretrained.IDENTITY:
        return False
    session.say(
        f"{directory} was trained by a release that did not note what all pictures and input files hold: "
        "its checkpoints cannot be trusted to be of this scene, so it is trained again"
    )
    return True


class _StagesOfARun:
    """The stages of a method, trained in a directory, or loaded where its checkpoints say that they are finished.

    loaded      entries that the registries are asked for meanwhile, as it grows
    """

    def __init__(self, session: Session, request: RunRequest, directory: Path, loaded: list[Entry]) -> None:
        session.load_kernels()
        self.session, self.request, self.directory = session, request, directory
        self.resolved, self.scene = request.resolved, session.scene(request.resolved)
        self.method: Method = pretrained.make_method(session.plugins, self.resolved)
        self.stages = list(self.method.stages())
        last = self.stages[-1]
        self.options = last.raster_options(last.iterations, self.scene.background)
        ppl = self.resolved.ppl
        self.rasterizer = NegotiatedRasterizer(
            session.plugins,
            device=session.device,
            prefer=ppl.raster.prefer,
            forbid=ppl.raster.forbid,
            suggested=list(dict.fromkeys(name for stage in self.stages for name in stage.prefer)),
        )
        self.parts = StageParts(session.plugins, self.stages, ppl, loaded, self.rasterizer)
        self.before: dict[str, dict[str, Any]] = {}

    def train(self, *, stop_after: int | None, watched: bool) -> tuple[SplatModel, dict[str, Any]]:
        """Return the model and the facts that are reported of its training.

        watched     plugins may watch it; False: it is only loaded
        """
        session, resolved, directory = self.session, self.resolved, self.directory
        scenes_before = pretrained.starts(session, resolved)
        if resolved.ppl.eval_every:
            decode_all(self.scene.test)  # here, so that they do not count as memory of the training
        started = StartedTraining(resolved.method, directory, self.scene, self.rasterizer)
        watching = session.plugins.hook.run_started(training=started) if watched else []
        cores = CoreTime()
        with watched_by(watching, session.plugins, session.say) as after_step:
            outcome = TrainingRun(
                self.stages,
                lambda: self.method.create_model(self.scene, stream(resolved.ppl.seed, "init")).to(session.device),
                self.scene,
                resolved.ppl,
                self.rasterizer,
                directory=directory / CHECKPOINTS,
                # The content besides its key, so that a refused resume can say what differs.
                identity={
                    **resolved.training_content(),
                    "identity": pretrained.IDENTITY,
                    "method_version": self.method.version,
                    "scene content": session.scene_digest(resolved),
                    **({"starts from": scenes_before} if scenes_before else {}),
                },
                trained=self._frozen,
                stop_after=stop_after,
                resume=self.request.resume,
                allow_changed_plan=self.request.allow_changed_plan,
                on_step=after_step,
                evaluate=self._evaluate,
                log_path=directory / LOG,
                provided=self.parts.since_asked,
            ).train()
        return outcome.model, {**self._facts(outcome), "contended": contention("train", cores)}

    def _facts(self, outcome: TrainOutcome) -> dict[str, Any]:
        return {
            **{name: getattr(outcome, name) for name in TrainBlock.model_fields if hasattr(outcome, name)},
            "stages": [{"name": name, "seconds": seconds} for name, seconds in outcome.stage_seconds.items()],
            "pretraining": self.before,
            "peak_bytes": outcome.peak_memory,
            "memory_kind": "cuda" if self.session.device.type == "cuda" else "rss",
            "breakdown_s": outcome.breakdown or None,
            "plan": outcome.plan,
            "rasterizers": outcome.rasterizers,
            "phases": self.parts.phases(outcome.provided),
            "raster": raster_header(self.options),
        }

    def _frozen(self, name: str) -> SplatModel:
        """Return the trained scene that a stage starts from or is taught by."""
        if name not in pretrained.named_scenes(self.method):
            raise SplatwizardError(
                f"a stage of '{self.resolved.method}' asks for a trained '{name}' scene, which no stage names in "
                "`starts_from` or `taught_by`: its training could not be told from one with another such scene"
            )
        with self.parts.elsewhere():
            source = trained_scene(self.session, name, self.resolved, self.request.out)
        base = pretrained.base_config(self.session.plugins, name, self.resolved)
        self.before[name] = _pretraining_facts(source, base)
        return source.model

    def _evaluate(self, model: SplatModel, step: int) -> dict[str, float]:
        """Return the metrics of the test views that the log keeps on the way."""
        plugins = self.session.plugins
        result = evaluate(
            model,
            self.scene.test,
            self.rasterizer,
            plugins,
            device=self.session.device,
            options=replace(self.options, background=self.scene.background),
            metrics=quick_metrics(plugins.metrics),
            label=f"evaluate at step {step:,}",
        )
        return {name: metric.mean for name, metric in result.metrics.items() if metric.mean is not None}


def _pretraining_facts(source: TrainedModel, base: ResolvedConfig) -> dict[str, Any]:
    """Return what is reported of a scene that a training started from; what nobody knows of a file is None."""
    facts = source.facts
    if "file" in facts:
        return picked(PretrainingBlock, {"made_by": {}}, facts)
    told = {"file": {}, "preset": base.preset, "config": base.config.model_dump(mode="json")}
    return picked(PretrainingBlock, facts, told, {"train_s": total_seconds(facts)})


def pretraining(facts: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a training started from, by method; of one of an older release its seconds alone."""
    older = {name: {"train_s": seconds} for name, seconds in facts.get("pretraining_s", {}).items()}
    return dict(facts.get("pretraining", older))


def total_seconds(facts: Mapping[str, Any]) -> float | None:
    """Return the seconds of a training with those of what it started from; None if that came from a file."""
    seconds = [facts["train_s"], *(each["train_s"] for each in pretraining(facts).values())]
    return None if None in seconds else sum(seconds)
