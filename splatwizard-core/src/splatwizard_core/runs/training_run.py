"""Training inside a run directory: resumed, shared between rate points, and starting from trained scenes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from splatwizard_core.errors import SplatwizardError
from splatwizard_core.evaluation.evaluate import evaluate, raster_header
from splatwizard_core.evaluation.metrics import default_metrics
from splatwizard_core.files import write_atomic
from splatwizard_core.gaussians.splat_model import SplatModel
from splatwizard_core.plugins import Entry
from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.runs.config import ResolvedConfig
from splatwizard_core.runs.phases import StageParts
from splatwizard_core.runs.session import Session, TrainedModel
from splatwizard_core.runs.start import IDENTITY, base_config, make_method, named_scenes, starts, training_key
from splatwizard_core.runs.steps import StepLog
from splatwizard_core.runs.versions import changes, made_by
from splatwizard_core.scene.images import decode_all
from splatwizard_core.scene.scene import Scene
from splatwizard_core.streams import stream
from splatwizard_core.training.checkpoint import CheckpointStore
from splatwizard_core.training.pipeline import train_stages

CHECKPOINTS = "checkpoints"
STEP = "train"
BEGUN = "begun"
LOG = "log.jsonl"


def train(
    session: Session,
    resolved: ResolvedConfig,
    directory: Path,
    *,
    trained: Callable[[str], TrainedModel],
    resume: bool = True,
    allow_changed_plan: bool = False,
    stop_after: int | None = None,
    cached: Path | None = None,
) -> TrainedModel:
    """The trained model of this configuration on this scene, from wherever it already exists.

    directory   run directory, held by the caller; another rate point's beside it is used if it was trained equally
    resume      False: neither a checkpoint nor another rate point's training is used, only what this session trained
    trained     (method name) -> the trained scene that a stage starts from
    stop_after  end the process's part of the training after this many steps (raises KeyboardInterrupt then)
    cached      where it lies if another method's run has made it to start from
    """
    key = training_key(session, resolved)
    in_memory = session.trained(key)
    if in_memory is not None:
        return _share(session, in_memory, directory, resolved)
    # Starting again takes nothing old, least of all from a neighbour that the same command is about to clear.
    home = (finished_directory(directory, key, cached) if resume else None) or directory
    scene = session.scene(resolved)
    steps = StepLog(home)
    done = steps.done(STEP, key) if holds_training(home, key) else None
    if done is None:
        resume = resume and not _is_of_an_older_release(session, home)
        session.say(f"training {resolved.method} on {scene.name} ({resolved.preset} preset, {session.device})")
        if not CheckpointStore(home / CHECKPOINTS).paths():  # those of another training are refused, and stay as is
            steps.finish(BEGUN, key, {})  # whoever wants the same scene meanwhile may wait for it
    with session.plugins.recording() as loaded:
        outcome_model, facts = run_stages(
            session, resolved, scene, home, loaded,
            trained=trained, resume=resume or done is not None, allow_changed_plan=allow_changed_plan,
            stop_after=stop_after,
        )  # fmt: skip
    if done is None:
        rasterizers = session.plugins.rasterizers
        served = [rasterizers.entry(name) for name in facts["rasterizers"].values() if name in rasterizers]
        facts["made_by"] = made_by(session.plugins, [*loaded, *served])
        facts["trained_in"] = resolved.rate
        steps.finish(STEP, key, facts)
    else:
        facts = done  # what was measured when it was trained, not when it was loaded
        changed = changes(session.plugins, facts.get("made_by"))
        if changed:
            session.say(f"{home} was trained with {', '.join(changed)}; it is used as it is (--fresh trains again)")
    found = TrainedModel(outcome_model, key, facts)
    session.remember(found)
    if home == directory:
        return found
    if home == cached and not (directory / LOG).exists():
        write_atomic(directory / LOG, (home / LOG).read_text("utf-8"))  # reports look for it here
    return _share(session, found, directory, resolved)


def _is_of_an_older_release(session: Session, directory: Path) -> bool:
    """Whether the checkpoints of a directory do not say all that they were made from; told, since they go then."""
    identity = CheckpointStore(directory / CHECKPOINTS).identity()
    if identity is None or identity.get("identity") == IDENTITY:
        return False
    session.say(
        f"{directory} was trained by a release that did not note what all pictures and input files hold: "
        "its checkpoints cannot be trusted to be of this scene, so it is trained again"
    )
    return True


def _share(session: Session, found: TrainedModel, directory: Path, resolved: ResolvedConfig) -> TrainedModel:
    """Note in this rate point's directory whose training it uses."""
    steps = StepLog(directory)
    if steps.done(STEP, found.key) is None:
        other = found.facts.get("trained_in")
        made = "that others started from" if other == resolved.rate else f"of {other}"
        session.say(f"rate point {resolved.rate} shares the training {made}")
        steps.finish(STEP, found.key, {**found.facts, "checkpoints": "elsewhere"})
    return found


def finished_directory(directory: Path, key: str, cached: Path | None = None) -> Path | None:
    """The directory (this, that of another rate point beside it, or `cached`) that holds this training, finished."""
    candidates = [directory]
    if directory.parent.is_dir():
        candidates += sorted(p for p in directory.parent.iterdir() if p.is_dir() and p != directory)
    if cached is not None:
        candidates.append(cached)
    for candidate in candidates:
        if holds_training(candidate, key):
            return candidate
    return None


def holds_training(directory: Path, key: str) -> bool:
    """Whether a run directory holds this training, finished, with its own checkpoints."""
    facts = StepLog(directory).done(STEP, key)
    if facts is None or "checkpoints" in facts:
        return False
    return bool(CheckpointStore(directory / CHECKPOINTS).paths())


def run_stages(
    session: Session,
    resolved: ResolvedConfig,
    scene: Scene,
    directory: Path,
    loaded: list[Entry],
    *,
    trained: Callable[[str], TrainedModel],
    resume: bool,
    allow_changed_plan: bool,
    stop_after: int | None,
) -> tuple[SplatModel, dict[str, Any]]:
    """Train (or load, where the checkpoints say it is finished); the model and what is reported of the training.

    loaded      what the registries are asked for meanwhile, as it grows
    """
    session.load_kernels()
    method = make_method(session.plugins, resolved)
    stages = list(method.stages())
    scenes = named_scenes(method)
    ppl = resolved.ppl
    suggested = list(dict.fromkeys(name for stage in stages for name in stage.prefer))
    rasterizer = NegotiatedRasterizer(
        session.plugins,
        device=session.device,
        prefer=ppl.raster.prefer,
        forbid=ppl.raster.forbid,
        suggested=suggested,
    )
    parts = StageParts(session.plugins, stages, ppl, loaded, rasterizer)
    before: dict[str, dict[str, Any]] = {}

    def frozen(name: str) -> SplatModel:
        if name not in scenes:
            raise SplatwizardError(
                f"a stage of '{resolved.method}' asks for a trained '{name}' scene, which no stage names in "
                "`starts_from` or `taught_by`: its training could not be told from one with another such scene"
            )
        with parts.elsewhere():
            source = trained(name)
        before[name] = _told_of(source, base_config(session.plugins, name, resolved))
        return source.model

    def create_model() -> SplatModel:
        return method.create_model(scene, stream(ppl.seed, "init")).to(session.device)

    def test_views(model: SplatModel, step: int) -> dict[str, float]:
        """What the log keeps of an evaluation on the way."""
        last = stages[-1]
        options = replace(last.raster_options(last.iterations, scene.background), background=scene.background)
        result = evaluate(
            model,
            scene.test,
            rasterizer,
            session.plugins,
            device=session.device,
            options=options,
            metrics=default_metrics(session.plugins.metrics, on_the_way=True),
            label=f"evaluate at step {step:,}",
        )
        return {name: metric.mean for name, metric in result.metrics.items() if metric.mean is not None}

    scenes_before = starts(session, resolved)
    if ppl.eval_every:
        decode_all(scene.test)  # here, so that they do not count as memory of the training
    outcome = train_stages(
        stages,
        create_model,
        scene,
        ppl,
        rasterizer,
        directory=directory / CHECKPOINTS,
        # The content besides its key, so that a refused resume can say what differs.
        identity={
            **resolved.training_content(),
            "identity": IDENTITY,
            "method_version": method.version,
            "scene content": session.scene_digest(resolved),
            **({"starts from": scenes_before} if scenes_before else {}),
        },
        trained=frozen,
        stop_after=stop_after,
        resume=resume,
        allow_changed_plan=allow_changed_plan,
        evaluate=test_views,
        log_path=directory / LOG,
        provided=parts.since_asked,
    )
    background = scene.background
    last = stages[-1]
    facts = {
        "train_s": outcome.train_s,
        "stages": [{"name": name, "seconds": seconds} for name, seconds in outcome.stage_seconds.items()],
        "pretraining": before,
        "steps": outcome.steps,
        "peak_bytes": outcome.peak_memory,
        "memory_kind": "cuda" if session.device.type == "cuda" else "rss",
        "pictures_in": outcome.pictures_in,
        "breakdown_s": outcome.breakdown or None,
        "plan": outcome.plan,
        "rasterizers": outcome.rasterizers,
        "phases": parts.phases(outcome.provided),
        "raster": raster_header(last.raster_options(last.iterations, background)),
    }
    return outcome.model, facts


def _told_of(source: TrainedModel, base: ResolvedConfig) -> dict[str, Any]:
    """What is reported of a scene that a training started from; what nobody knows of a file is None."""
    facts = source.facts
    if "file" in facts:
        return {
            "file": facts["file"], "made_by": {}, "preset": None, "config": None, "steps": None, "train_s": None
        }  # fmt: skip
    inner = [each["train_s"] for each in pretraining(facts).values()]
    return {
        "file": {},
        "made_by": facts["made_by"],
        "preset": base.preset,
        "config": base.config.model_dump(mode="json"),
        "steps": facts["steps"],
        "train_s": None if None in inner else facts["train_s"] + sum(inner),
    }


def pretraining(facts: dict[str, Any]) -> dict[str, Any]:
    """What a training started from, by method; of one of an older release its seconds alone."""
    if "pretraining" in facts:
        found: dict[str, Any] = facts["pretraining"]
        return found
    return {name: {"train_s": seconds} for name, seconds in facts.get("pretraining_s", {}).items()}
