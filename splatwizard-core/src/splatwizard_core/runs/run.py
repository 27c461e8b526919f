"""One run: train -> encode -> decode in a fresh process -> evaluate in another -> metrics.json.

Every finished step is remembered with what it was made from, so a run that was interrupted goes on where it was and
a finished one is not done again.
"""

from __future__ import annotations

from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from splatwizard_core.errors import SplatwizardError, UserInputError
from splatwizard_core.evaluation.metrics import MetricSetup, metric_identities
from splatwizard_core.files import file_sha256
from splatwizard_core.runs.config import METRICS, ResolvedConfig, content_hash
from splatwizard_core.runs.decode import REPEATS
from splatwizard_core.runs.directory import (
    ENCODED,
    RENDERS,
    RunRequest,
    StepLog,
    begin,
    run_directory,
    write_config,
)
from splatwizard_core.runs.encode import encode
from splatwizard_core.runs.fresh import decode_fresh, run_fresh
from splatwizard_core.runs.lock import directory_lock
from splatwizard_core.runs.measure import Scope
from splatwizard_core.runs.phases import phases_of_run
from splatwizard_core.runs.pretrained import make_method, training_key
from splatwizard_core.runs.record import (
    FILE_NAME,
    SCHEMA,
    CodecBlock,
    PretrainingBlock,
    Record,
    RecordFile,
    TrainBlock,
    complete_record,
    picked,
    read_record,
)
from splatwizard_core.runs.session import Session, TrainedModel
from splatwizard_core.runs.training import pretraining, train
from splatwizard_core.runs.versions import changes, installed, providers
from splatwizard_core.scene.images import check_pictures, decode_all
from splatwizard_core.training.keys import dotted

MEASURING = 2  # raised when `sw decode` and `sw eval` come to report more: a step that reported less is done again


def run(session: Session, request: RunRequest) -> tuple[Record, Path]:
    """Run the whole chain for one scene, method and rate point; returns the record and the run directory.

    Raises RunLockedError if another process writes there, and whatever a step raises.
    """
    resolved = request.resolved
    directory = run_directory(request)
    _check_scene(session, request, directory)
    with directory_lock(directory, say=session.say):
        begin(directory, request)
        steps = StepLog(directory)
        train_key = training_key(session, resolved)
        encoded = directory / ENCODED
        encode_key = content_hash([train_key, resolved.config_content()])
        encoding = _encoded(session, steps, encode_key, encoded)
        if encoding is not None:
            finished = _finished_record(session, directory, steps, request, encoding)
            if finished is not None:
                session.say(f"{directory} is finished; nothing to do (--fresh does it again)")
                return finished, directory
        else:
            trained = train_in(session, request, directory)
            steps = StepLog(directory)  # training has written into it
            method = make_method(session.plugins, resolved)
            encoding = encode(method, trained.model, trained.facts["raster"], encoded, session.device)
            session.say(f"encoded {encoding['bytes']:,} bytes in {encoding['encode_s']:.2f} s")
            steps.finish("encode", encode_key, encoding)
        training = steps.done("train", train_key) or train_in(session, request, directory).facts
        write_config(directory, resolved)
        decoded = _decode_step(session, steps, encoded, encoding, max(REPEATS, request.repeats))
        measured = _evaluate_step(session, steps, request, directory, encoding)
        if decoded["digest"] != measured["digest"]:
            raise SplatwizardError(
                f"{encoded}: the decoding and the evaluating process got different models from the same file; "
                f"method '{resolved.method}' does not decode deterministically"
            )
        record = _record(session, resolved, training, encoding, decoded, measured)
        record.write(directory / FILE_NAME)
        key = _record_key(session, request, encoding)
        steps.finish("record", key, {"sha256": encoding["sha256"], "asked": measured["asked"]})
    return record, directory


def train_only(session: Session, request: RunRequest) -> tuple[TrainedModel, Path]:
    """Do the training step of a run; `run` with the same request goes on from there."""
    directory = run_directory(request)
    _check_scene(session, request, directory)
    with directory_lock(directory, say=session.say):
        begin(directory, request)
        return train_in(session, request, directory), directory


def train_in(session: Session, request: RunRequest, directory: Path, *, stop_after: int | None = None) -> TrainedModel:
    """Do the training step alone, in a directory that the caller holds."""
    found = train(session, request, directory, stop_after=stop_after)
    write_config(directory, request.resolved)
    return found


def _check_scene(session: Session, request: RunRequest, directory: Path) -> None:
    """Load the scene, and all pictures of a run that begins, before anything is written."""
    scene = session.scene(request.resolved)
    if not directory.exists() or not request.resume:
        decode_all(scene.train)  # training reads them anyway, and they stay
        check_pictures(scene.test)


def _encoded(session: Session, steps: StepLog, key: str, encoded: Path) -> dict[str, Any] | None:
    """Return the facts of the encode step if its file is as it was written, and would be written the same today."""
    facts = steps.done("encode", key)
    if facts is None or not encoded.is_file() or file_sha256(encoded) != facts["sha256"]:
        return None
    changed = changes(session.plugins, facts.get("made_by"))
    if changed:
        session.say(f"{encoded} was made with {', '.join(changed)}: encoding again")
        return None
    return facts


def _decode_key(session: Session, encoding: dict[str, Any]) -> str:
    return content_hash([encoding["sha256"], str(session.device), MEASURING, encoding["made_by"]])


def _evaluate_key(session: Session, resolved: ResolvedConfig, encoding: dict[str, Any]) -> str:
    used = installed(session.plugins, [*encoding["made_by"], *providers(session.plugins, "metric", "rasterizer")])
    return content_hash(
        [
            encoding["sha256"], session.scene_digest(resolved), str(session.device),
            resolved.ppl.raster.model_dump(mode="json"), session.plugins.metrics.names, MEASURING, used,
        ]
    )  # fmt: skip


def _record_key(session: Session, request: RunRequest, encoding: dict[str, Any]) -> str:
    """Return the key of a record: the scene and the versions stand in the keys of the steps before."""
    resolved = request.resolved
    return content_hash(
        [
            training_key(session, resolved), resolved.config_hash(), _decode_key(session, encoding),
            _evaluate_key(session, resolved, encoding), SCHEMA,
        ]
    )  # fmt: skip


def _finished_record(
    session: Session, directory: Path, steps: StepLog, request: RunRequest, encoding: dict[str, Any]
) -> Record | None:
    """Return the record of a run that was finished from the same inputs."""
    facts = steps.done("record", _record_key(session, request, encoding))
    if facts is None or not _scope(session, request).is_held_by(facts.get("asked")):
        return None
    try:
        record = read_record(directory / FILE_NAME)
    except UserInputError:
        return None  # it is written again
    return record if record.file.sha256 == encoding["sha256"] else None


def _decode_step(
    session: Session, steps: StepLog, encoded: Path, encoding: dict[str, Any], repeats: int
) -> dict[str, Any]:
    key = _decode_key(session, encoding)
    facts = steps.done("decode", key)
    if facts is None or len(facts["decode_runs_s"]) < repeats:
        facts = decode_fresh(encoded, str(session.device), repeats=repeats)
        counted = ", ".join(f"{n:,} {name.removeprefix('num_')}" for name, n in facts["counts"].items())
        session.say(f"decoded in a fresh process: {facts['decode_s']:.2f} s, {counted}")
        steps.finish("decode", key, facts)
    return facts


def _evaluate_step(
    session: Session, steps: StepLog, request: RunRequest, directory: Path, encoding: dict[str, Any]
) -> dict[str, Any]:
    resolved = request.resolved
    key = _evaluate_key(session, resolved, encoding)
    facts, scope = steps.done("evaluate", key), _scope(session, request)
    if facts is None or not scope.is_held_by(facts.get("asked")):
        arguments = ["eval", str(directory / ENCODED), "--scene", resolved.absolute_scene]
        arguments += eval_options(resolved, str(session.device))
        arguments += ["--renders", str(directory / RENDERS), "--repeats", str(request.repeats), "--quiet", "--json"]
        facts = {**run_fresh(arguments), "asked": scope.as_dict()}
        steps.finish("evaluate", key, facts)
    return facts


def _scope(session: Session, request: RunRequest) -> Scope:
    """Return the extent of the measurement, with the packages and weights that are there now."""
    setup = MetricSetup(session.device, request.resolved.metrics)
    return Scope(request.repeats, metric_identities(session.plugins.metrics, setup))


def eval_options(resolved: ResolvedConfig, device: str) -> list[str]:
    """Return the options that make `sw eval` see the scene, and set up its metrics, as this run does."""
    ppl = resolved.ppl
    values: dict[str, Any] = {"seed": ppl.seed, "threads": ppl.threads}
    values |= {key: "none" if value is None else value for key, value in resolved.scene_options.items()}
    values |= {
        f"raster.{key}": ",".join(names)
        for key, names in (("prefer", ppl.raster.prefer), ("forbid", ppl.raster.forbid))
        if names
    }
    values |= dotted(resolved.metrics, METRICS)
    return ["--device", device, *(word for key, value in values.items() for word in ("--set", f"{key}={value}"))]


def _record(
    session: Session,
    resolved: ResolvedConfig,
    training: dict[str, Any],
    encoding: dict[str, Any],
    decoded: dict[str, Any],
    measured: dict[str, Any],
) -> Record:
    """Return the record from the facts of the steps: each block takes its fields from whatever step reported them."""
    entry = session.plugins.methods.entry(resolved.method)
    before, seconds, unknown = _pretraining(training)
    steps = {**training, **measured, **encoding, **decoded}
    values = {
        **steps,
        "distribution": f"{entry.distribution} {entry.version}",
        "preset": resolved.preset,
        "rate": resolved.rate,
        "config": resolved.as_dict(),
        "config_hash": resolved.config_hash(),
        "environment": measured["environment"],
        "file": picked(RecordFile, steps),
        "codec": picked(CodecBlock, {"peak_decode_bytes": decoded["peak_bytes"]}, steps),
        "train": picked(TrainBlock, training, {"pretraining": before, "with_pretraining_s": seconds}),
        "rasterizers": {"train": training["rasterizers"], "render": measured["rasterizers"]},
        "phases": phases_of_run(session.plugins, training, encoding, measured["rasterizers"]),
        "unknown": {**measured["unknown"], **unknown},
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
    }
    return complete_record(picked(Record, values))


def _pretraining(training: dict[str, Any]) -> tuple[dict[str, Any], float | None, dict[str, str]]:
    """Return what a run started from, the seconds of its training with theirs, and reasons for nulls by dotted name."""
    found, total, unknown = {}, training["train_s"], dict[str, str]()
    for name, facts in pretraining(training).items():
        found[name] = scene = picked(PretrainingBlock, {"file": {}, "made_by": {}}, facts)
        why = "it came from a file, which does not say" if scene["file"] else "a release that did not note it"
        unknown |= {f"train.pretraining.{name}.{key}": why for key, value in scene.items() if value is None}
        if scene["train_s"] is None:
            unknown["train.with_pretraining_s"] = f"the {name} scene that it started from came from a file"
            total = None
        elif total is not None:
            total += scene["train_s"]
    return found, total, unknown
