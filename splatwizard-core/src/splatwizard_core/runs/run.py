"""One run: train -> encode -> decode in a fresh process -> evaluate in another -> metrics.json.

Every finished step is remembered with what it was made from, so a run that was interrupted goes on where it was and
a finished one is not done again.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from splatwizard_core.errors import SceneError, SplatwizardError, UserInputError
from splatwizard_core.evaluation.metrics import MetricSettings
from splatwizard_core.files import file_sha256, remove_folder, sweep, write_atomic
from splatwizard_core.runs.asked import Asked, what_is_asked
from splatwizard_core.runs.cache import cached_directory, trained_scene
from splatwizard_core.runs.config import SCENE_KEYS, ResolvedConfig, absolute_spec, content_hash
from splatwizard_core.runs.decoding import REPEATS
from splatwizard_core.runs.encoding import encode
from splatwizard_core.runs.fresh import decode_fresh, run_fresh
from splatwizard_core.runs.lock import directory_lock
from splatwizard_core.runs.phases import phases_of_run
from splatwizard_core.runs.record import FILE_NAME, SCHEMA, Record, missing_reasons, read_record
from splatwizard_core.runs.session import Session, TrainedModel
from splatwizard_core.runs.start import make_method, training_key
from splatwizard_core.runs.steps import StepLog
from splatwizard_core.runs.training_run import CHECKPOINTS, pretraining, train
from splatwizard_core.runs.versions import changes, installed, providers
from splatwizard_core.scene.images import check_pictures, decode_all

ENCODED = "scene.swz"
CONFIG = "config.toml"
RENDERS = "renders"
MEASURING = 2  # what `sw decode` and `sw eval` report; a step that reported less is done again
# What says that something is finished goes first when a directory is cleared.
OWN_FILES = ("steps.json", FILE_NAME, CHECKPOINTS, CONFIG, "log.jsonl", ENCODED, RENDERS, "truth", "report.html")


@dataclass(frozen=True)
class RunRequest:
    """What to run.

    out         root of all run directories
    resume      use what is there; False: discard it
    metric_settings     of metrics, group -> key -> value
    repeats     how often rendering speed is measured; decoding is timed as often, and at least three times
    """

    resolved: ResolvedConfig
    out: Path
    resume: bool = True
    allow_changed_plan: bool = False
    metric_settings: MetricSettings = field(default_factory=dict)
    repeats: int = 1


def run(session: Session, request: RunRequest) -> tuple[Record, Path]:
    """The whole chain for one scene, method and rate point; the record and the run directory.

    Raises RunLockedError if another process writes there, and whatever a step raises.
    """
    resolved = request.resolved
    directory = run_directory(request)
    _check_scene(session, request, directory)
    with directory_lock(directory, say=session.say):
        _begin(directory, request)
        steps = StepLog(directory)
        train_key = training_key(session, resolved)
        encoded = directory / ENCODED
        encode_key = _encode_key(train_key, resolved)
        facts = _encoded(session, steps, encode_key, encoded)
        if facts is not None:
            finished = _finished_record(session, directory, steps, request, facts)
            if finished is not None:
                session.say(f"{directory} is finished; nothing to do (--fresh does it again)")
                return finished, directory
        else:
            trained = train_in(session, request, directory)
            steps = StepLog(directory)  # training has written into it
            method = make_method(session.plugins, resolved)
            facts = encode(method, trained.model, trained.facts["raster"], encoded, session.device)
            session.say(f"encoded {facts['bytes']:,} bytes in {facts['encode_s']:.2f} s")
            steps.finish("encode", encode_key, facts)
        training = steps.done("train", train_key) or train_in(session, request, directory).facts
        write_config(directory, resolved)
        decoded = _decode_step(session, steps, encoded, facts, max(REPEATS, request.repeats))
        measured = _evaluate_step(session, steps, request, directory, facts)
        if decoded["digest"] != measured["digest"]:
            raise SplatwizardError(
                f"{encoded}: the decoding and the evaluating process got different models from the same file; "
                f"method '{resolved.method}' does not decode deterministically"
            )
        record = _assemble(session, resolved, training, facts, decoded, measured)
        record.write(directory / FILE_NAME)
        key = _record_key(session, request, facts)
        steps.finish("record", key, {"sha256": facts["sha256"], "asked": measured["asked"]})
    return record, directory


def train_only(session: Session, request: RunRequest) -> tuple[TrainedModel, Path]:
    """The training step of a run; `run` with the same request goes on from there."""
    directory = run_directory(request)
    _check_scene(session, request, directory)
    with directory_lock(directory, say=session.say):
        _begin(directory, request)
        return train_in(session, request, directory), directory


def run_directory(request: RunRequest) -> Path:
    """out/<scene>/<method>/<rate>."""
    resolved = request.resolved
    name = Path(absolute_spec(resolved.scene_spec)).name.replace(":", "-")
    return request.out / name / resolved.method / resolved.rate


def train_in(session: Session, request: RunRequest, directory: Path, *, stop_after: int | None = None) -> TrainedModel:
    """The training step alone, in a directory that the caller holds."""

    def start(name: str) -> TrainedModel:
        return trained_scene(session, name, request.resolved, request.out)

    key = training_key(session, request.resolved)
    found = train(
        session, request.resolved, directory,
        trained=start, resume=request.resume, allow_changed_plan=request.allow_changed_plan, stop_after=stop_after,
        cached=cached_directory(session, request.resolved, request.out, key),
    )  # fmt: skip
    write_config(directory, request.resolved)
    return found


def _check_scene(session: Session, request: RunRequest, directory: Path) -> None:
    """Before anything is written: the scene can be named in a record and loaded, and all pictures of a run that begins
    decoded.
    """
    _check_name(absolute_spec(request.resolved.scene_spec))
    scene = session.scene(request.resolved)
    if not directory.exists() or not request.resume:
        decode_all(scene.train)  # training reads them anyway, and they stay
        check_pictures(scene.test)


def _check_name(scene: str) -> None:
    """config.toml and the record name the scene's folder, as text."""
    try:
        scene.encode()
    except UnicodeEncodeError:
        shown = os.fsencode(scene).decode(errors="replace")
        raise SceneError(
            f"scene '{shown}': the name of its folder, or the locale, is not UTF-8: rename it, or set LC_ALL=C.UTF-8",
            path=shown,
        ) from None


def _begin(directory: Path, request: RunRequest) -> None:
    """Clear what is to be cleared, and what a killed process left half written."""
    for folder in (directory, *(path for path in map(directory.joinpath, OWN_FILES) if path.is_dir())):
        sweep(folder)
    if not request.resume:
        discard(directory)
    if not (directory / CONFIG).exists():
        write_config(directory, request.resolved)


def write_config(directory: Path, resolved: ResolvedConfig) -> None:
    """config.toml, which repeats the run. A changed one replaces it only once its training is accepted."""
    write_atomic(directory / CONFIG, resolved.toml())


def discard(directory: Path) -> None:
    """Remove what a run wrote; anything else in the directory stays."""
    for name in OWN_FILES:
        path = directory / name
        if path.is_dir() and not path.is_symlink():
            remove_folder(path)
        else:
            path.unlink(missing_ok=True)


def _encode_key(train_key: str, resolved: ResolvedConfig) -> str:
    return content_hash([train_key, resolved.config_content()])


def _encoded(session: Session, steps: StepLog, key: str, encoded: Path) -> dict[str, Any] | None:
    """The facts of the encode step if its file is there as it was written, and would be written the same today."""
    facts = steps.done("encode", key)
    if facts is None or not encoded.is_file() or file_sha256(encoded) != facts["sha256"]:
        return None
    changed = changes(session.plugins, facts.get("made_by"))
    if changed:
        session.say(f"{encoded} was made with {', '.join(changed)}: encoding again")
        return None
    return facts


def _decode_key(session: Session, facts: dict[str, Any]) -> str:
    return content_hash([facts["sha256"], str(session.device), MEASURING, facts["made_by"]])


def _evaluate_key(session: Session, resolved: ResolvedConfig, facts: dict[str, Any]) -> str:
    used = installed(session.plugins, [*facts["made_by"], *providers(session.plugins, "metric", "rasterizer")])
    return content_hash(
        [
            facts["sha256"], session.scene_digest(resolved), str(session.device),
            resolved.ppl.raster.model_dump(mode="json"), session.plugins.metrics.names, MEASURING, used,
        ]
    )  # fmt: skip


def _record_key(session: Session, request: RunRequest, facts: dict[str, Any]) -> str:
    """What a record was made from: the scene and the versions stand in the keys of the steps before."""
    resolved = request.resolved
    return content_hash(
        [
            training_key(session, resolved), resolved.config_hash(), _decode_key(session, facts),
            _evaluate_key(session, resolved, facts), SCHEMA,
        ]
    )  # fmt: skip


def _finished_record(
    session: Session, directory: Path, steps: StepLog, request: RunRequest, encoded: dict[str, Any]
) -> Record | None:
    """The record of a run that was finished from the same inputs."""
    facts = steps.done("record", _record_key(session, request, encoded))
    if facts is None or not _asked(session, request).is_held_by(facts.get("asked")):
        return None
    try:
        record = read_record(directory / FILE_NAME)
    except UserInputError:
        return None  # it is written again
    return record if record.file.sha256 == encoded["sha256"] else None


def _decode_step(
    session: Session, steps: StepLog, encoded: Path, encoding: dict[str, Any], repeats: int
) -> dict[str, Any]:
    key = _decode_key(session, encoding)
    facts = steps.done("decode", key)
    if facts is None or len(facts["decode_runs_s"]) < repeats:
        facts = decode_fresh(encoded, str(session.device), repeats=repeats)
        session.say(f"decoded in a fresh process: {facts['decode_s']:.2f} s, {_counted(facts['counts'])}")
        steps.finish("decode", key, facts)
    return facts


def _counted(counts: dict[str, int]) -> str:
    return ", ".join(f"{n:,} {name.removeprefix('num_')}" for name, n in counts.items())


def _evaluate_step(
    session: Session, steps: StepLog, request: RunRequest, directory: Path, encoding: dict[str, Any]
) -> dict[str, Any]:
    resolved = request.resolved
    key = _evaluate_key(session, resolved, encoding)
    facts, asked = steps.done("evaluate", key), _asked(session, request)
    if facts is None or not asked.is_held_by(facts.get("asked")):
        arguments = ["eval", str(directory / ENCODED), "--scene", absolute_spec(request.resolved.scene_spec)]
        arguments += eval_options(resolved, str(session.device))
        arguments += ["--renders", str(directory / RENDERS), "--repeats", str(request.repeats), "--quiet", "--json"]
        for group, settings in request.metric_settings.items():
            for key, value in settings.items():
                arguments += ["--set", f"metrics.{group}.{key}={value}"]
        facts = {**run_fresh(arguments), "asked": asked.as_dict()}
        steps.finish("evaluate", key, facts)
    return facts


def _asked(session: Session, request: RunRequest) -> Asked:
    return what_is_asked(session, repeats=request.repeats, metric_settings=request.metric_settings)


def eval_options(resolved: ResolvedConfig, device: str) -> list[str]:
    """The options that make `sw eval` see the scene as this run does."""
    found = ["--device", device, "--set", f"seed={resolved.ppl.seed}", "--set", f"threads={resolved.ppl.threads}"]
    for key in SCENE_KEYS:
        value = getattr(resolved.scene, key)
        found += ["--set", f"{key}={'none' if value is None else value}"]
    for key in ("prefer", "forbid"):
        names = getattr(resolved.ppl.raster, key)
        found += ["--set", f"raster.{key}={','.join(names)}"] if names else []
    return found


def _assemble(
    session: Session,
    resolved: ResolvedConfig,
    training: dict[str, Any],
    encoding: dict[str, Any],
    decoded: dict[str, Any],
    measured: dict[str, Any],
) -> Record:
    """The record from what the steps reported."""
    entry = session.plugins.methods.entry(resolved.method)
    unknown = dict(measured["unknown"])
    unknown["geometry"] = "not asked for"
    if training["breakdown_s"] is None:
        unknown["train.breakdown_s"] = "not profiled (--set profile=stages)"
    if measured["speed"]["spread"] is None:
        unknown["speed.spread"] = "measured once (--repeats N)"
    if training.get("pictures_in") is None:
        unknown["train.pictures_in"] = "trained by a release that did not note it"
    if training["peak_bytes"] is None:
        unknown["train.peak_bytes"] = "not measured"
    if measured["memory"]["peak_reserved_bytes"] is None:
        unknown["memory.peak_reserved_bytes"] = "a CPU has no such pool"
    before, seconds = _pretraining(training, unknown)
    phases = phases_of_run(session.plugins, training, encoding, measured["rasterizers"])
    if phases is None:
        unknown["phases"] = "trained or encoded by a release that did not note them"
    record = Record(
        method=resolved.method,
        method_version=decoded["method_version"],
        distribution=f"{entry.distribution} {entry.version}",
        preset=resolved.preset,
        rate=resolved.rate,
        config=resolved.as_dict(),
        config_hash=resolved.config_hash(),
        **{k: measured[k] for k in _FROM_EVALUATION},
        file={
            "bytes": encoding["bytes"],
            "sha256": encoding["sha256"],
            "sections": decoded["sections"],
            "digest": decoded["digest"],
        },
        counts=decoded["counts"],
        codec={
            "encode_s": encoding["encode_s"],
            "decode_s": decoded["decode_s"],
            "decode_runs_s": decoded["decode_runs_s"],
            "decode_spread": decoded["decode_spread"],
            "first_decode_s": decoded["first_decode_s"],
            "jit_s": decoded["jit_s"],
            "peak_decode_bytes": decoded["peak_bytes"],
            "memory_kind": decoded["memory_kind"],
        },
        train={
            **{k: training[k] for k in _FROM_TRAINING},
            "pictures_in": training.get("pictures_in"),
            "pretraining": before,
            "with_pretraining_s": seconds,
        },
        plan=training["plan"],
        rasterizers={"train": training["rasterizers"], "render": measured["rasterizers"]},
        phases=phases,
        environment=measured["environment"],
        unknown=unknown,
        date=datetime.now(timezone.utc).isoformat(timespec="seconds"),
    )
    without = missing_reasons(record)
    if without:
        raise SplatwizardError(f"the record has null without a reason: {', '.join(without)}")
    return record


def _pretraining(training: dict[str, Any], unknown: dict[str, str]) -> tuple[dict[str, Any], float | None]:
    """What a run started from, and the seconds of its training with theirs; reasons for nulls go into `unknown`."""
    found, total = {}, training["train_s"]
    for name, facts in pretraining(training).items():
        came = "it came from a file, which does not say" if facts.get("file") else "a release that did not note it"
        found[name] = {"file": {}, "made_by": {}, **dict.fromkeys(("preset", "config", "steps", "train_s")), **facts}
        for key in ("preset", "config", "steps", "train_s"):
            if found[name][key] is None:
                unknown[f"train.pretraining.{name}.{key}"] = came
        if facts["train_s"] is None:
            unknown["train.with_pretraining_s"] = f"the {name} scene that it started from came from a file"
            total = None
        elif total is not None:
            total += facts["train_s"]
    return found, total


_FROM_EVALUATION = (
    "dataset", "scene", "protocol", "train_views", "test_views", "views", "metrics", "visible_gaussians",
    "speed", "memory", "flags",
)  # fmt: skip
_FROM_TRAINING = ("train_s", "stages", "steps", "peak_bytes", "memory_kind", "breakdown_s", "trained_in")
