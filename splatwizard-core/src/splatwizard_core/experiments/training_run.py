"""Training inside a run directory: resumed, shared between rate points, and starting from trained scenes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from splatwizard_core.evaluation.evaluate import evaluate, raster_header
from splatwizard_core.evaluation.metrics import default_metrics
from splatwizard_core.experiments.config import ResolvedConfig, content_hash
from splatwizard_core.experiments.method import Method
from splatwizard_core.experiments.session import Session, TrainedModel
from splatwizard_core.experiments.steps import StepLog
from splatwizard_core.experiments.versions import changes, made_by
from splatwizard_core.gaussians.splat_model import SplatModel
from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.scene.images import decode_all
from splatwizard_core.scene.scene import Scene
from splatwizard_core.streams import stream
from splatwizard_core.training.checkpoint import CheckpointStore
from splatwizard_core.training.pipeline import train_stages

CHECKPOINTS = "checkpoints"
STEP = "train"
IDENTITY = 2  # raised when checkpoints come to say something else of what they were made from


def make_method(session: Session, resolved: ResolvedConfig) -> Method:
    """The configured method."""
    method: Method = session.plugins.methods.load(resolved.method)(session.plugins, resolved.config)
    return method


def training_key(session: Session, resolved: ResolvedConfig) -> str:
    """What a training was made from: equal keys mean an interchangeable model."""
    cls = session.plugins.methods.load(resolved.method)
    return content_hash([IDENTITY, resolved.training_hash(), session.scene_digest(resolved), cls.name, cls.version])


def train(
    session: Session,
    resolved: ResolvedConfig,
    directory: Path,
    *,
    trained: Callable[[str], TrainedModel],
    resume: bool = True,
    allow_changed_plan: bool = False,
    stop_after: int | None = None,
) -> TrainedModel:
    """The trained model of this configuration on this scene, from wherever it already exists.

    directory   run directory, held by the caller; another rate point's beside it is used if it was trained equally
    resume      False: neither a checkpoint nor another rate point's training is used, only what this session trained
    trained     (method name) -> the trained scene that a stage starts from
    stop_after  end the process's part of the training after this many steps (raises KeyboardInterrupt then)
    """
    key = training_key(session, resolved)
    in_memory = session.trained(key)
    if in_memory is not None:
        return _share(session, in_memory, directory, resolved)
    # Starting again takes nothing old, least of all from a neighbour that the same command is about to clear.
    home = (finished_directory(directory, key) if resume else None) or directory
    scene = session.scene(resolved)
    steps = StepLog(home)
    done = steps.done(STEP, key) if holds_training(home, key) else None
    if done is None:
        resume = resume and not _is_of_an_older_release(session, home)
        session.say(f"training {resolved.method} on {scene.name} ({resolved.preset} preset, {session.device})")
    with session.plugins.recording() as loaded:
        outcome_model, facts = run_stages(
            session, resolved, scene, home,
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
    return _share(session, found, directory, resolved) if home != directory else found


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
        session.say(f"rate point {resolved.rate} shares the training of {found.facts.get('trained_in')}")
        steps.finish(STEP, found.key, {**found.facts, "checkpoints": "elsewhere"})
    return found


def finished_directory(directory: Path, key: str) -> Path | None:
    """The run directory (this, or that of another rate point beside it) that holds this very training, finished."""
    candidates = [directory]
    if directory.parent.is_dir():
        candidates += sorted(p for p in directory.parent.iterdir() if p.is_dir() and p != directory)
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
    *,
    trained: Callable[[str], TrainedModel],
    resume: bool,
    allow_changed_plan: bool,
    stop_after: int | None,
) -> tuple[SplatModel, dict[str, Any]]:
    """Train (or load, where the checkpoints say it is finished); the model and what is reported of the training."""
    session.load_kernels()
    method = make_method(session, resolved)
    stages = list(method.stages())
    ppl = resolved.ppl
    suggested = list(dict.fromkeys(name for stage in stages for name in stage.prefer))
    rasterizer = NegotiatedRasterizer(
        session.plugins,
        device=session.device,
        prefer=ppl.raster.prefer,
        forbid=ppl.raster.forbid,
        suggested=suggested,
    )
    before: dict[str, float] = {}

    def frozen(name: str) -> SplatModel:
        source = trained(name)
        before[name] = source.facts["train_s"]
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
        },
        trained=frozen,
        stop_after=stop_after,
        resume=resume,
        allow_changed_plan=allow_changed_plan,
        evaluate=test_views,
        log_path=directory / "log.jsonl",
    )
    background = scene.background
    last = stages[-1]
    facts = {
        "train_s": outcome.train_s,
        "stages": [{"name": name, "seconds": seconds} for name, seconds in outcome.stage_seconds.items()],
        "pretraining_s": before,
        "steps": outcome.steps,
        "peak_bytes": outcome.peak_memory,
        "memory_kind": "cuda" if session.device.type == "cuda" else "rss",
        "pictures_in": outcome.pictures_in,
        "breakdown_s": outcome.stage_breakdown,
        "plan": outcome.plan,
        "rasterizers": outcome.rasterizers,
        "raster": raster_header(last.raster_options(last.iterations, background)),
    }
    return outcome.model, facts
