"""The result record, metrics.json, that every table is made from. A versioned schema; unknown values are null.

A value that is null has its reason in `unknown`, by dotted name; no value is ever 0 for "not measured".
A field is declared here (or in `training.measurements`, `evaluation.speed`) and filled where it is measured. From the
declaration follow why it may be null (`WhyNull`), its row of docs/protocol.md (tools/record_docs.py), what readers of
other releases' records take, and with `Shown` its row in the report.
Source: evaluation protocol, result record.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import ConfigDict, Field, ValidationError

from splatwizard_core.base.block import Block, MemoryKind, Shown, WhyNull
from splatwizard_core.base.files import write_atomic
from splatwizard_core.base.strict_json import load_strict
from splatwizard_core.errors import SplatwizardError, UserInputError
from splatwizard_core.evaluation.speed import SpeedBlock, SpreadBlock
from splatwizard_core.training.measurements import LoopFigures, Provided, StagePlan

SCHEMA = 3
FILE_NAME = "metrics.json"
DESCRIBED_ELSEWHERE = ("config", "environment")  # fields whose nulls need no reason here
OF_A_FILE = WhyNull("it came from a file, which does not say")
Score = Annotated[float, Field(ge=-1e12, le=1e12)]
"""Value of a metric, with room for sums, means and slopes."""


class ProtocolBlock(Block):
    """The rules that make results comparable: only equal ids may stand in one table. Later rules may stand beside."""

    model_config = ConfigDict(extra="allow")

    id: str
    dataset: str = ""
    images: str = Field("", description="picture folder")
    resolution: int = Field(-1, description="-1 (1600 px rule), 1, 2, 4, 8, or a width in pixels")
    split: str = ""
    background: str = ""
    principal_point: str = ""
    quantize8: bool = Field(True, description="renders were rounded to 8 bit before comparing")


class MetricBlock(Block):
    """One image metric over the test views, or one of the model itself: without `per_view`, details in `geometry`."""

    mean: Score | None = Field(None, description="over the test views")
    per_view: list[Score | None] = Field([], description="in the order of `views`; null: not finite, see `unknown`")
    direction: str = Field("higher", description="higher or lower is better")
    diagnostic: bool = Field(False, description="computed to tell conventions apart, not for tables")
    made_with: dict[str, str] = Field({}, description="what else the values depend on: versions, weights, checksums")


class TrainingPsnrBlock(Block):
    """PSNR of the decoded model over its training views, dB, by the rules of the test views."""

    mean: float | None = None
    median: float | None = None
    quantile_05: float | None = Field(None, description="5 % of the views have this or less")
    far_below: dict[str, float] = Field({}, description="views more than 8 dB below the median, the lowest first")


class MemoryBlock(Block):
    """Bytes; `kind` says what was measured: "cuda" (torch's allocator) or "rss" (growth of the resident set)."""

    kind: MemoryKind | None = Field(None, description="what was measured")
    model_bytes: int | None = Field(None, description="held after the model was decoded and prepared")
    peak_load_bytes: int | None = Field(None, description="peak from opening the file to the decoded model")
    peak_render_bytes: int | None = Field(None, description="peak over the measured frames, the model included")
    peak_reserved_bytes: Annotated[int | None, WhyNull("a CPU has no such pool")] = None


class StageBlock(Block):
    """One training stage, or what a stage started from."""

    name: str
    seconds: float


class PretrainingBlock(Block):
    """The trained scene of another method that a training started from, or was taught by."""

    file: dict[str, str] = Field({}, description="name and sha256 of the .ply that it came from; empty: trained here")
    preset: Annotated[str | None, OF_A_FILE] = None
    config: Annotated[dict[str, Any] | None, OF_A_FILE] = Field(
        None, description="every value of the method that trained it"
    )
    steps: Annotated[int | None, OF_A_FILE] = None
    train_s: Annotated[float | None, OF_A_FILE] = Field(None, description="with what it started from itself")
    made_by: dict[str, str] = Field({}, description="distribution -> version")


class TrainBlock(LoopFigures):
    """Training: wall clock of the loop without evaluation, checkpoints and loading."""

    train_s: float | None = Field(None, description="of all stages")
    stages: list[StageBlock] = Field([], description="seconds of each")
    with_pretraining_s: Annotated[float | None, WhyNull("a scene that it started from came from a file")] = Field(
        None, description="with the training of the scenes it starts from"
    )
    pretraining: dict[str, PretrainingBlock] = Field({}, description="method -> its scene that this one used")
    steps: int | None = None
    trained_in: str | None = Field(None, description="rate point whose training this one shares (its own, as a rule)")


class DecodeFigures(Block):
    """Decoding in a fresh process, wall clock, device synchronised."""

    decode_s: Annotated[float | None, Shown("decoding", "s")] = Field(None, description="median, fresh process")
    decode_runs_s: list[float] = Field([], description="of each timed decode")
    decode_spread: SpreadBlock | None = None
    first_decode_s: float | None = Field(None, description="the untimed decode before them: late imports included")
    jit_s: float | None = Field(None, description="loading or compiling native modules; in no other figure")
    memory_kind: MemoryKind | None = None


class CodecBlock(DecodeFigures):
    """Encoding and decoding, wall clock, device synchronised."""

    encode_s: Annotated[float | None, Shown("encoding", "s")] = Field(None, description="to the closed file")
    peak_decode_bytes: Annotated[int | None, Shown("decoding memory", "bytes")] = Field(
        None, description="growth over the first decode"
    )


class RecordFile(Block):
    """The encoded file."""

    bytes: int = Field(gt=0, description="size of the single file")
    sha256: str | None = None
    sections: dict[str, Annotated[int, Field(ge=0)]] = Field(
        {}, description="bytes by section, header included; they sum to `bytes`"
    )
    digest: str | None = Field(
        None, description="SHA-256 of the decoded model, equal in the decoding and the evaluating process"
    )


class PhaseBlock(Block):
    """One phase of a run."""

    phase: str = Field(
        description='"train: NAME" (a stage), "train" (before the first), "encode", "render", "evaluate"'
    )
    provided_by: list[Provided] = []


class PrefixBlock(Block):
    """A file with cuts, measured as if it ended at one of them."""

    packets: int
    bytes: int = Field(gt=0, description="up to the cut, header included")
    counts: dict[str, int] = Field({}, description="as `counts` of the whole file")
    metrics: dict[str, Score] = Field({}, description="means over the test views")


class Quality(Block):
    """Measurements of a model on a scene, for `sw eval` and the record."""

    dataset: str = Field("unknown", description="family of the scene")
    scene: str = Field(min_length=1)
    scene_warnings: list[str] = Field([], description="what was found in the scene and not used as it stands")
    scene_origin: tuple[float, float, float] = Field(
        (0.0, 0.0, 0.0), description="where the origin of model and cameras lies in the world of the scene's files"
    )
    protocol: ProtocolBlock
    train_views: int | None = None
    test_views: int | None = None
    views: list[str] = Field([], description="names of the test views")
    metrics: dict[str, MetricBlock]
    counts: dict[str, int] = Field({}, description="num_gaussians, num_anchors, ... after decoding")
    visible_gaussians: Annotated[float | None, Shown("visible primitives")] = Field(
        None, description="mean over the test views of those with radius > 0"
    )
    geometry: Annotated[dict[str, dict[str, Any]] | None, WhyNull("not asked for")] = Field(
        None, description="by metric over the model its protocol, and what its value consists of"
    )
    training_psnr: Annotated[TrainingPsnrBlock | None, WhyNull("not measured")] = None
    prefixes: list[PrefixBlock] = Field([], description="of a file with cuts each one, the whole file last")
    environment: dict[str, Any] = Field({}, description="packages, device, driver, clocks, threads, seed")
    contended: dict[str, float] = Field(
        {}, description="train, encode, decode, render: those that had to share the cores -> the share that they had"
    )
    flags: list[str] = Field(
        [],
        description="what a reader of the numbers must know: `fit`, `rss`, `infinite`, `not-a-number`, "
        "`unverified-weights`, `device-bound` (the file decodes only on the machine that made it), `non-finite-rows` "
        "(rows with NaN or infinities, not drawn), `contended`",
    )
    unknown: dict[str, str] = Field({}, description="dotted name of each null -> why")


class Record(Quality):
    """One scene, one method, one rate point, one file."""

    schema_version: int = Field(SCHEMA, strict=True)
    method: str = Field(min_length=1, description="name that it is registered under")
    method_version: int | None = Field(None, description="version of its file layout")
    distribution: str | None = Field(None, description="pip distribution and version that the method comes from")
    preset: str | None = None
    rate: str | None = None
    config: dict[str, Any] | None = Field(None, description="every value, by block, and where each was set")
    config_hash: str | None = Field(None, description="SHA-256 over every given value")
    file: RecordFile
    codec: CodecBlock = CodecBlock()
    speed: SpeedBlock = SpeedBlock()
    memory: MemoryBlock = MemoryBlock()
    train: TrainBlock = TrainBlock()
    plan: list[StagePlan] = Field([], description="the executed plan of each stage")
    rasterizers: dict[str, dict[str, str]] = Field({}, description="phase -> features asked for -> who served them")
    raster_options: dict[str, dict[str, Any]] = Field(
        {}, description="phase -> options of drawing that are not the defaults: profile, antialias, eps2d, clamp_color"
    )
    phases: list[PhaseBlock] = Field([], description="who served each phase, with distribution and version")
    date: str | None = Field(None, description="ISO 8601, UTC")

    def write(self, path: Path) -> None:
        """Write it, atomically."""
        write_atomic(path, self.model_dump_json(indent=2) + "\n")


def read_record(path: Path) -> Record:
    """Return a record from its file. Raises UserInputError that names what is wrong first."""
    try:
        record = Record.model_validate(load_strict(path.read_bytes()))
    except OSError as error:
        raise UserInputError(f"{path}: cannot be read: {error.strerror}") from error
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "the file"
        raise UserInputError(f"{path}: not a result record of schema {SCHEMA}: {where}: {first['msg']}") from None
    except ValueError as error:
        raise UserInputError(f"{path}: not a result record of schema {SCHEMA}: {error}") from None
    if record.schema_version != SCHEMA:
        told = f"schema_version: it is {record.schema_version}"
        raise UserInputError(f"{path}: not a result record of schema {SCHEMA}: {told}")
    return record


def complete_record(values: Mapping[str, Any]) -> Record:
    """Return the record of these values, each null with its reason. Raises SplatwizardError for a null without one."""
    record = Record.model_validate(values)
    told = record.unknown
    marked = {name: mark.reason for name, mark in _nulls(record) if mark is not None and name not in told}
    record = record.model_copy(update={"unknown": {**told, **marked}})
    without = missing_reasons(record)
    if without:
        raise SplatwizardError(f"the record has null without a reason: {', '.join(without)}")
    return record


def missing_reasons(record: Record) -> list[str]:
    """List the dotted names of values that are null without a reason; a valid record has none."""
    return [name for name, _ in _nulls(record) if name not in record.unknown]


def _nulls(values: Block | dict[str, Any], prefix: str = "") -> Iterator[tuple[str, WhyNull | None]]:
    """Yield the dotted name of each null, and the mark of its field; not what blocks hold that others describe."""
    fields = type(values).model_fields if isinstance(values, Block) else {}
    for name, value in values.items() if isinstance(values, dict) else values:
        if value is None:
            marks = fields[name].metadata if name in fields else []
            yield prefix + name, next((mark for mark in marks if isinstance(mark, WhyNull)), None)
        elif isinstance(value, Block | dict) and not (isinstance(values, Block) and name in DESCRIBED_ELSEWHERE):
            yield from _nulls(value, f"{prefix}{name}.")
