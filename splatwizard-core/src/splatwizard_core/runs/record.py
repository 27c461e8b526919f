"""The result record, metrics.json, that every table is made from. A versioned schema; unknown values are null.

A value that is null has its reason in `unknown`, by dotted name; no value is ever 0 for "not measured".
A field is added here and where it is measured: `picked` carries it into the record, `WhyNull` says why it may be null.
Source: evaluation protocol, result record.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from splatwizard_core.errors import SplatwizardError, UserInputError
from splatwizard_native import write_atomic

SCHEMA: Literal[3] = 3
FILE_NAME = "metrics.json"
DESCRIBED_ELSEWHERE = ("config", "environment")  # fields whose nulls need no reason here


@dataclass(frozen=True)
class WhyNull:
    """Marks a field with the reason of its null, where whoever measured it told none."""

    reason: str


OF_A_FILE = WhyNull("it came from a file, which does not say")


class Part(BaseModel):
    """Base of the record's blocks: nothing unknown, nothing that is not a number."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def picked(block: type[Part], *sources: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a block's fields, each from the last source that has it.

    None for one that no source has, unless it has a default; whatever else the sources hold is left out.
    """
    merged: dict[str, Any] = {}
    for source in sources:
        merged |= source
    return {
        name: merged.get(name) for name, field in block.model_fields.items() if name in merged or field.is_required()
    }


class ProtocolBlock(Part):
    """The rules that make results comparable: only equal ids may stand in one table. Later rules may stand beside."""

    model_config = ConfigDict(extra="allow", frozen=True, allow_inf_nan=False)

    id: str
    dataset: str
    images: str = Field(description="picture folder")
    resolution: int = Field(description="-1 (1600 px rule), 1, 2, 4, 8, or a width in pixels")
    split: str
    background: str
    principal_point: str
    quantize8: bool = Field(description="renders were rounded to 8 bit before comparing")


class MetricBlock(Part):
    """One image metric over the test views, or one of the model itself: without `per_view`, details in `geometry`."""

    mean: float | None
    per_view: list[float | None] = Field(description="in the order of `views`; null: not finite, as `unknown` says")
    direction: Literal["higher", "lower"]
    diagnostic: bool = Field(False, description="computed to tell conventions apart, not for tables")
    made_with: dict[str, str] = Field({}, description="what else the values depend on: versions, weights, checksums")


class TrainingPsnrBlock(Part):
    """PSNR of the decoded model over its training views, dB, by the rules of the test views."""

    mean: float | None
    median: float | None
    quantile_05: float | None = Field(description="5 % of the views have this or less")
    far_below: dict[str, float] = Field(description="views more than 8 dB below the median, the lowest first")


class SpreadBlock(Part):
    """Spread of repeated measurements of one thing."""

    n: int = Field(ge=2, description="measurements")
    mean: float
    std: float = Field(description="of the sample (n - 1)")
    min: float
    max: float


class SpeedBlock(Part):
    """Rendering, by the FPS protocol, of the model decoded from the file."""

    fps: float
    latency_ms_median: float
    latency_ms_p95: float
    jit_s: float | None = Field(description="loading or compiling native modules, before everything else")
    prepare_s: float = Field(description="view-independent caches, built once, not in `fps`")
    load_s: float | None = Field(description="from opening the file to the first frame; without `jit_s`")
    frames: int = Field(description="measured, over all repeats")
    rounds: int = Field(description="over all views, in each repeat")
    repeats: int
    views: int
    warmup_frames: int
    spread: Annotated[dict[str, SpreadBlock] | None, WhyNull("measured once (--repeats N)")] = Field(
        description="of fps and the latencies over the repeats"
    )
    image_size: tuple[int, int] = Field(description="width, height of the first view drawn")
    drawn_by: dict[str, str] = Field({}, description="rasterizers that drew the frames -> whose kernels those are")
    default_fps: dict[str, float] = Field(
        {}, description="`fps` by the kernels that draw where a file names none; empty: those drew the frames"
    )


class MemoryBlock(Part):
    """Bytes; `kind` says what was measured: "cuda" (torch's allocator) or "rss" (growth of the resident set)."""

    kind: Literal["cuda", "rss"]
    model_bytes: int = Field(description="held after the model was decoded and prepared")
    peak_load_bytes: int | None = Field(description="peak from opening the file to the decoded model")
    peak_render_bytes: int = Field(description="peak over the measured frames, the model included")
    peak_reserved_bytes: Annotated[int | None, WhyNull("a CPU has no such pool")] = None


class StageBlock(Part):
    """One training stage, or what a stage started from."""

    name: str
    seconds: float


class PretrainingBlock(Part):
    """The trained scene of another method that a training started from, or was taught by."""

    file: dict[str, str] = Field(description="name and sha256 of the .ply that it came from; empty: trained here")
    preset: Annotated[str | None, OF_A_FILE]
    config: Annotated[dict[str, Any] | None, OF_A_FILE] = Field(description="every value of the method that trained it")
    steps: Annotated[int | None, OF_A_FILE]
    train_s: Annotated[float | None, OF_A_FILE] = Field(description="with what it started from itself")
    made_by: dict[str, str] = Field(description="distribution -> version")


class TrainBlock(Part):
    """Training: wall clock of the loop without evaluation, checkpoints and loading."""

    train_s: float | None
    stages: list[StageBlock]
    with_pretraining_s: Annotated[float | None, WhyNull("a scene that it started from came from a file")] = Field(
        description="with the training of the scenes it starts from"
    )
    pretraining: dict[str, PretrainingBlock] = Field(description="method -> its scene that this one used")
    steps: int | None
    peak_bytes: Annotated[int | None, WhyNull("not measured")] = Field(
        description="over the loop; without evaluation and checkpoints since schema 2"
    )
    memory_kind: Literal["cuda", "rss"] | None
    pictures_in: str = Field(description="where the training pictures lay: host, cuda")
    breakdown_s: Annotated[dict[str, dict[str, float]] | None, WhyNull("not profiled (--set profile=stages)")] = Field(
        description="stage -> part of a step -> seconds, if profiled"
    )
    trained_in: str | None = Field(description="rate point whose training this one shares (its own, as a rule)")


class CodecBlock(Part):
    """Encoding and decoding, wall clock, device synchronised."""

    encode_s: float | None
    decode_s: float = Field(description="median of the timed decodes")
    decode_runs_s: list[float]
    decode_spread: SpreadBlock | None
    first_decode_s: float = Field(description="the untimed decode before them: late imports included")
    jit_s: float | None = Field(description="loading or compiling native modules, before all decodes")
    peak_decode_bytes: int
    memory_kind: Literal["cuda", "rss"]


class RecordFile(Part):
    """The encoded file."""

    bytes: int = Field(gt=0, description="size of the single file")
    sha256: str
    sections: dict[str, int] = Field(description="bytes by section, header included; they sum to `bytes`")
    digest: str = Field(description="SHA-256 of the decoded model, equal in the decoding and the evaluating process")


class ProvidedBlock(Part):
    """A part that served: a registered thing by kind and name, a training `stage`, or a `task` of another package."""

    kind: str
    name: str
    distribution: str = Field(description="pip distribution; empty: of none that is installed")
    version: str


class PhaseBlock(Part):
    """One phase of a run."""

    phase: str = Field(
        description='"train: NAME" (a stage), "train" (before the first), "encode", "render", "evaluate"'
    )
    provided_by: list[ProvidedBlock]


class Record(Part):
    """One scene, one method, one rate point, one file."""

    schema_version: Literal[3] = SCHEMA
    method: str
    method_version: int
    distribution: str = Field(description="pip distribution and version that the method comes from")
    preset: str | None
    rate: str | None
    config: dict[str, Any] | None = Field(description="every value, by block, and where each was set")
    config_hash: str | None
    dataset: str
    scene: str
    scene_warnings: list[str] = Field([], description="what was found in the scene and not used as it stands")
    scene_origin: tuple[float, float, float] = Field(
        (0.0, 0.0, 0.0), description="where the origin of model and cameras lies in the world of the scene's files"
    )
    protocol: ProtocolBlock
    train_views: int
    test_views: int
    views: list[str] = Field(description="names of the test views")
    metrics: dict[str, MetricBlock]
    file: RecordFile
    counts: dict[str, int] = Field(description="num_gaussians, num_anchors, ... after decoding")
    visible_gaussians: float = Field(description="mean over the test views of those with radius > 0")
    codec: CodecBlock
    speed: SpeedBlock
    memory: MemoryBlock
    train: TrainBlock
    geometry: Annotated[dict[str, dict[str, Any]] | None, WhyNull("not asked for")] = None
    training_psnr: Annotated[TrainingPsnrBlock | None, WhyNull("not measured")] = None
    plan: list[dict[str, Any]] = Field(description="of each stage its name, steps, tasks, and `looked_up`")
    rasterizers: dict[str, dict[str, str]] = Field(description="phase -> features asked for -> who served them")
    raster_options: dict[str, dict[str, Any]] = Field(
        {}, description="phase -> options of drawing that are not the defaults: profile, antialias, eps2d, clamp_color"
    )
    phases: list[PhaseBlock] = Field(description="who served each phase, with distribution and version")
    environment: dict[str, Any]
    contended: dict[str, float] = Field(
        {}, description="train, encode, decode, render: those that had to share the cores -> the share that they had"
    )
    flags: list[str] = Field(description="fit, rss, ...")
    unknown: dict[str, str] = Field(description="dotted name of each null -> why")
    date: str = Field(description="ISO 8601, UTC")

    def write(self, path: Path) -> None:
        """Write it, atomically."""
        write_atomic(path, self.model_dump_json(indent=2) + "\n")


def read_record(path: Path) -> Record:
    """Return a record from its file. Raises UserInputError that names what is wrong first."""
    try:
        return Record.model_validate_json(path.read_bytes())
    except OSError as error:
        raise UserInputError(f"{path}: cannot be read: {error.strerror}") from error
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "the file"
        raise UserInputError(f"{path}: not a result record of schema {SCHEMA}: {where}: {first['msg']}") from None


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


def _nulls(values: Part | dict[str, Any], prefix: str = "") -> Iterator[tuple[str, WhyNull | None]]:
    """Yield the dotted name of each null, and the mark of its field; not what blocks hold that others describe."""
    fields = type(values).model_fields if isinstance(values, Part) else {}
    for name, value in values.items() if isinstance(values, dict) else values:
        if value is None:
            marks = fields[name].metadata if name in fields else []
            yield prefix + name, next((mark for mark in marks if isinstance(mark, WhyNull)), None)
        elif isinstance(value, Part | dict) and not (isinstance(values, Part) and name in DESCRIBED_ELSEWHERE):
            yield from _nulls(value, f"{prefix}{name}.")
