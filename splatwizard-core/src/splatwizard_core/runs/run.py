"""One run: train -> encode -> decode in a fresh process -> evaluate in another -> metrics.json.

Every finished step is remembered with what it was made from, so a run that was interrupted goes on where it was and
a finished one is not done again.
"""

from __future__ import annotations

import contextlib
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from splatwizard_core.base.files import file_sha256
from splatwizard_core.base.progress import counted
from splatwizard_core.base.warned import WARNED
from splatwizard_core.errors import SplatwizardError, UserInputError
from splatwizard_core.evaluation.metrics import MetricSetup, chosen_metrics, metric_identities
from splatwizard_core.plugins.versions import changes, installed, providers
from splatwizard_core.runs import record as schema
from splatwizard_core.runs.config import ResolvedConfig, content_hash
from splatwizard_core.runs.decode import REPEATS
from splatwizard_core.runs.directory import CONFIG, ENCODED, RENDERS, RunRequest, StepLog, held_directory, write_config
from splatwizard_core.runs.encode import encode_trained
from splatwizard_core.runs.facts import (
    CONTENDED,
    DecodingFacts,
    EncodingFacts,
    Extent,
    Measurement,
    Recorded,
    TrainingFacts,
)
from splatwizard_core.runs.fresh import decode_fresh, run_fresh, started_ahead
from splatwizard_core.runs.identity import training_key
from splatwizard_core.runs.phases import phases_of_run
from splatwizard_core.runs.session import Session, TrainedModel
from splatwizard_core.runs.training import train
from splatwizard_native import available_cores

MEASURING = 2  # raised when `sw decode` and `sw eval` come to report more: a step that reported less is done again


def run(session: Session, request: RunRequest) -> tuple[schema.Record, Path]:
    """Run the whole chain for one scene, method and rate point; returns the record and the run directory.

    Raises RunLockedError if another process writes there, and whatever a step raises.
    """
    resolved = request.resolved
    with held_directory(session, request) as directory, contextlib.ExitStack() as stack:
        ahead: list[Any] = []  # of the evaluating process, which imports while the decoding one does
        steps, encoded = StepLog(directory), directory / ENCODED
        train_key, repeats = training_key(session, resolved), max(REPEATS, request.repeats)

        def encode_it() -> EncodingFacts:
            trained = train_in(session, request, directory)
            facts = encode_trained(session, resolved, trained, encoded)
            session.say(f"encoded {facts.bytes:,} bytes in {facts.encode_s:.2f} s")
            return facts

        def decode_it() -> DecodingFacts:
            if available_cores() > 1:
                ahead.append(stack.enter_context(started_ahead()))
            facts = decode_fresh(encoded, str(session.device), repeats=repeats, threads=resolved.ppl.threads)
            session.say(f"decoded in a fresh process: {facts.decode_s:.2f} s, {counted(facts.counts)}")
            return facts

        def evaluate_it() -> Measurement:
            arguments = ["eval", str(encoded), "--config", str(directory / CONFIG), "--device", str(session.device)]
            arguments += ["--renders", str(directory / RENDERS), "--repeats", str(request.repeats), "--quiet", "--json"]
            arguments += ["--prefixes", *["--geometry"] * request.geometry]
            told = [*session.told, *(f"WARNING: {line}" for line in WARNED)]
            facts = Measurement.model_validate(run_fresh(arguments, told=told, ahead=ahead.pop() if ahead else None))
            return facts.model_copy(update={"asked": asked})

        encoding = steps.once(
            "encode", content_hash([train_key, resolved.config_content()]), encode_it, EncodingFacts,
            holds=lambda facts: _is_current(session, encoded, facts),
        )  # fmt: skip
        keys = step_keys(session, resolved, encoding)
        # The extent of the measurement, with the packages and weights that are there now.
        setup = MetricSetup(session.device, resolved.metrics)
        wanted = chosen_metrics(session.plugins.metrics, None, geometry=request.geometry)
        asked = Extent(
            repeats=request.repeats, metrics=metric_identities(wanted, setup), eval_train=resolved.ppl.eval_train
        )
        finished = steps.done("record", keys["record"], Recorded)
        if finished is not None and finished.asked.holds(asked):
            with contextlib.suppress(UserInputError):  # a damaged record is written again
                record = schema.read_record(directory / schema.FILE_NAME)
                if record.file.sha256 == encoding.sha256:
                    session.say(f"{directory} is finished; nothing to do (--fresh does it again)")
                    return record, directory
        training = steps.done("train", train_key, TrainingFacts) or train_in(session, request, directory).facts
        write_config(directory, resolved)
        decoded = steps.once(
            "decode", keys["decode"], decode_it, DecodingFacts, holds=lambda facts: len(facts.decode_runs_s) >= repeats
        )
        measured = steps.once(
            "evaluate", keys["evaluate"], evaluate_it, Measurement,
            holds=lambda facts: facts.asked is not None and facts.asked.holds(asked),
        )  # fmt: skip
        if decoded.digest != measured.digest:
            raise SplatwizardError(
                f"{encoded}: the decoding and the evaluating process got different models from the same file; "
                f"method '{resolved.method}' does not decode deterministically"
            )
        record = _record(session, resolved, training, encoding, decoded, measured)
        record.write(directory / schema.FILE_NAME)
        done = Recorded(sha256=encoding.sha256, asked=measured.asked or asked)
        steps.finish("record", keys["record"], done)
    return record, directory


def train_only(session: Session, request: RunRequest) -> tuple[TrainedModel, Path]:
    """Do the training step of a run; `run` with the same request goes on from there."""
    with held_directory(session, request) as directory:
        return train_in(session, request, directory), directory


def train_in(session: Session, request: RunRequest, directory: Path, *, stop_after: int | None = None) -> TrainedModel:
    """Do the training step alone, in a directory that the caller holds."""
    found = train(session, request, directory, stop_after=stop_after)
    write_config(directory, request.resolved)
    return found


def _is_current(session: Session, encoded: Path, facts: EncodingFacts) -> bool:
    """Whether an encoded file is as it was written, and would be written the same today."""
    if not encoded.is_file() or file_sha256(encoded) != facts.sha256:
        return False
    changed = changes(session.plugins, facts.made_by)
    if changed:
        session.say(f"{encoded} was made with {', '.join(changed)}: encoding again")
    return not changed


def step_keys(session: Session, resolved: ResolvedConfig, encoding: EncodingFacts) -> dict[str, str]:
    """Map each step after encoding to the key of what it is made from; the record's holds those before it."""
    sha256, device = encoding.sha256, str(session.device)
    used = installed(session.plugins, [*encoding.made_by, *providers(session.plugins, "metric", "rasterizer")])
    decode = content_hash([sha256, device, MEASURING, encoding.made_by])
    evaluate = content_hash(
        [
            sha256, session.scene_digest(resolved), device,
            resolved.ppl.raster.model_dump(mode="json", exclude_none=True),
            session.plugins.metrics.names, MEASURING, used,
        ]
    )  # fmt: skip
    record = content_hash([training_key(session, resolved), resolved.config_hash(), decode, evaluate, schema.SCHEMA])
    return {"decode": decode, "evaluate": evaluate, "record": record}


def _record(
    session: Session,
    resolved: ResolvedConfig,
    training: TrainingFacts,
    encoding: EncodingFacts,
    decoded: DecodingFacts,
    measured: Measurement,
) -> schema.Record:
    """Return the record from the facts of the steps: each block takes its fields from whatever step reported them."""
    entry = session.plugins.methods.entry(resolved.method)
    contended = training.contended | encoding.contended | decoded.contended | measured.contended
    steps = {**training.model_dump(), **measured.model_dump(), **encoding.model_dump(), **decoded.model_dump()}
    return schema.complete_record(
        {
            **steps,
            "distribution": f"{entry.distribution} {entry.version}",
            "preset": resolved.preset,
            "rate": resolved.rate,
            "config": resolved.as_dict(),
            "config_hash": resolved.config_hash(),
            "file": steps,
            "codec": {**steps, "peak_decode_bytes": decoded.peak_bytes},
            "train": {**training.model_dump(), "with_pretraining_s": training.total_s},
            "rasterizers": {"train": training.rasterizers, "render": measured.rasterizers},
            "raster_options": {"train": training.raster, "render": measured.raster},
            "contended": contended,
            "flags": [*(flag for flag in measured.flags if flag != CONTENDED), *([CONTENDED] if contended else [])],
            "phases": [phase.model_dump() for phase in phases_of_run(session.plugins, training, encoding, measured)],
            "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        }
    )
