"""Reader of result records that any release of this software, or other software, wrote.

`record.Record` is what is written, strictly. A report reads also what older and newer releases wrote, and files that
strangers sent: it takes what it understands, says what it does not, and invents nothing.
"""

from __future__ import annotations

import json
import unicodedata
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from splatwizard_core.api import UserInputError
from splatwizard_core.tooling import SCHEMA
from splatwizard_native import json_reason
from sw_report import numbers
from sw_report.declared import metric_style, uncompressed

LONGEST_TEXT = 300
LARGEST_RECORD = 16_000_000  # bytes; ten thousand views with ten metrics take less than half of it
MOST_ITEMS = 20_000  # of a list or object of a record, such as its views


def clean(text: str) -> str:
    """Text that cannot reorder or hide what stands around it: control characters are replaced, length is bounded."""
    kept = text[: LONGEST_TEXT + 1]
    if not (kept.isascii() and kept.isprintable()):
        bad = ("Cc", "Cf", "Cs")
        kept = "".join("\N{REPLACEMENT CHARACTER}" if unicodedata.category(c) in bad else c for c in kept)
    return kept if len(kept) <= LONGEST_TEXT else kept[: LONGEST_TEXT - 1] + "…"


Text = Annotated[str, AfterValidator(clean)]
Score = Annotated[float, Field(ge=-1e12, le=1e12)]
"""Value of a metric, with room for sums, means and slopes."""


class Facts(BaseModel):
    """Base of the blocks: unknown keys are passed over."""

    model_config = ConfigDict(extra="ignore", frozen=True, allow_inf_nan=False)


class ProtocolFacts(Facts):
    """Protocol of a result. Only results of equal ids are comparable; the other rules stand beside it."""

    model_config = ConfigDict(extra="allow", frozen=True, allow_inf_nan=False)

    id: Text

    def rules(self) -> dict[str, Any]:
        """Every rule by name, without the id."""
        return {clean(name): value for name, value in self.model_dump().items() if name != "id"}

    def without_folder(self) -> str:
        """Id of all rules but the picture folder, which may differ between the scenes of one data set."""
        images = self.rules().get("images")
        parts = self.id.split("/")
        return "/".join("*" if part == images else part for part in parts) if isinstance(images, str) else self.id


class MetricFacts(Facts):
    """One image metric."""

    mean: Score | None = None
    per_view: list[Score | None] = []
    direction: Text = "higher"
    diagnostic: bool = False


class TrainingPsnrFacts(Facts):
    """PSNR over the training views, dB."""

    mean: float | None = None
    quantile_05: float | None = None


class FileFacts(Facts):
    """Encoded file; `sections` is bytes by section."""

    bytes: int = Field(gt=0)
    sha256: Text | None = None
    sections: dict[Text, Annotated[int, Field(ge=0)]] = {}


class CodecFacts(Facts):
    encode_s: float | None = None
    decode_s: float | None = None
    peak_decode_bytes: int | None = None


class SpeedFacts(Facts):
    fps: float | None = None
    latency_ms_median: float | None = None
    latency_ms_p95: float | None = None
    prepare_s: float | None = None
    image_size: tuple[int, int] | None = None


class MemoryFacts(Facts):
    kind: Text | None = None
    model_bytes: int | None = None
    peak_render_bytes: int | None = None


class PretrainingFacts(Facts):
    """A trained scene that a training started from; `file` is name and sha256 where it came from one."""

    file: dict[Text, Text] = {}
    preset: Text | None = None
    config: dict[str, Any] | None = None
    steps: int | None = None
    train_s: float | None = None


class TrainFacts(Facts):
    train_s: float | None = None
    pretraining: dict[Text, PretrainingFacts] | None = None
    with_pretraining_s: float | None = None
    steps: int | None = None
    peak_bytes: int | None = None
    memory_kind: Text | None = None
    breakdown_s: dict[Text, dict[Text, float]] | None = None
    trained_in: Text | None = None

    def all_steps(self) -> str:
        """Steps of the scenes that the training started from, or was taught by, and its own: `30,000 + 5,000`."""
        before = [numbers.count(scene.steps) if "name" not in scene.file else "file"
                  for scene in (self.pretraining or {}).values()]  # fmt: skip
        return " + ".join([*before, numbers.count(self.steps)])

    def started_from(self) -> str:
        """Trained scenes that the training started from, in words; empty if there are none."""
        found = []
        for name, scene in (self.pretraining or {}).items():
            steps = "" if scene.steps is None else f", {numbers.count(scene.steps)} steps"
            seconds = "" if scene.train_s is None else f", {numbers.seconds(scene.train_s)} s"
            preset = "" if scene.preset is None else f" ({scene.preset} preset{steps}{seconds})"
            origin = f" from the file {scene.file['name']}" if "name" in scene.file else preset
            found.append(f"a trained {name} scene{origin}")
        return "; ".join(found)


class PartFacts(Facts):
    """Part that served a phase (a rasterizer, a stage, a coder, ...), and the distribution that it comes from."""

    kind: Text
    name: Text
    distribution: Text = ""
    version: Text = ""


class PhaseFacts(Facts):
    phase: Text
    provided_by: list[PartFacts] = []

    def by_distribution(self) -> dict[str, list[str]]:
        """Distribution -> its parts that served: `sw-codecs 0.1` -> `coder octree`."""
        found: dict[str, list[str]] = {}
        for part in self.provided_by:
            owner = f"{part.distribution} {part.version}".strip() or "no distribution"
            found.setdefault(owner, []).append(f"{part.kind} {part.name}")
        return found


class StagePlan(Facts):
    """Plan of a training stage; of it, the values that were looked up for the scene, by dotted key."""

    looked_up: dict[Text, Any] = {}


class RunFacts(Facts):
    """One record. Only method, scene, protocol, metrics and the size of the file are indispensable."""

    schema_version: int = 0
    method: Text = Field(min_length=1)
    scene: Text = Field(min_length=1)
    protocol: ProtocolFacts
    file: FileFacts
    metrics: dict[Text, MetricFacts]
    distribution: Text | None = None
    method_version: int | None = None
    preset: Text | None = None
    rate: Text | None = None
    config: dict[str, Any] | None = None
    dataset: Text = "unknown"
    train_views: int | None = None
    test_views: int | None = None
    views: list[Text] = []
    counts: dict[Text, int] = {}
    visible_gaussians: float | None = None
    codec: CodecFacts = CodecFacts()
    speed: SpeedFacts = SpeedFacts()
    memory: MemoryFacts = MemoryFacts()
    train: TrainFacts = TrainFacts()
    geometry: dict[Text, dict[Text, Any]] | None = None
    training_psnr: TrainingPsnrFacts | None = None
    plan: list[StagePlan] = []
    rasterizers: dict[Text, dict[Text, Text]] = {}
    phases: list[PhaseFacts] = []
    environment: dict[Text, Any] = {}
    contended: dict[Text, float] = {}
    flags: list[Text] = []
    unknown: dict[Text, Text] = {}
    date: Text | None = None

    def uncompressed(self) -> str:
        """Number format of the parameters in the file, where nothing in it is compressed; empty otherwise."""
        encoded = (phase for phase in self.phases if phase.phase == "encode")
        return uncompressed((part.kind, part.name) for phase in encoded for part in phase.provided_by)

    def rate_label(self) -> str:
        """Name of the rate point, and "float32" beside it where the file is no compressed one; empty if neither is."""
        return ", ".join(filter(None, (self.rate, self.uncompressed())))

    def is_diagnostic(self, metric: str) -> bool:
        """Whether a metric only tells conventions apart, and stands in no table; older records do not say it."""
        return self.metrics[metric].diagnostic or metric_style(metric).diagnostic

    def mean(self, metric: str) -> float | None:
        """Mean of a metric over the test views, if it is known."""
        found = self.metrics.get(metric)
        return None if found is None else found.mean


OTHER_SCHEMA = f"record of schema {{}}, this release writes {SCHEMA}: a dash may stand for what only one has"
INDISPENSABLE = ("schema_version", "method", "scene", "protocol", "file", "metrics")


def _integer(digits: str) -> int:
    if len(digits) > 20:  # no float holds one of 400 digits
        raise ValueError(f"an integer of {len(digits):,} digits")
    return int(digits)


def _check_items(content: Any) -> None:
    """Raise ValueError for a list or object of more items than any record has."""
    waiting = [content]
    while waiting:
        part = waiting.pop()
        if len(part) > MOST_ITEMS:
            raise ValueError(f"a list or object of {len(part):,} items; {MOST_ITEMS:,} are the most")
        inside = part.values() if isinstance(part, dict) else part
        waiting += [each for each in inside if isinstance(each, (dict, list))]


def read_facts(path: Path) -> tuple[RunFacts, list[str]]:
    """Read a record; return its facts, and notes on parts of it that could not be understood.

    Raises UserInputError that names the first thing wrong, if an indispensable part is missing or makes no sense.
    """
    try:
        if path.stat().st_size > LARGEST_RECORD:
            raise UserInputError(f"{path}: {path.stat().st_size:,} bytes is too large for a result record")
        content = json.loads(path.read_text(encoding="utf-8"), parse_int=_integer)
        if not isinstance(content, dict):
            raise UserInputError(f"{path}: not a result record: it holds no object")
        _check_items(content)
    except OSError as error:
        raise UserInputError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise UserInputError(f"{path}: not a result record: {json_reason(error)}") from None
    notes: list[str] = []
    version = content.get("schema_version")
    if version != SCHEMA:
        notes.append(OTHER_SCHEMA.format(clean(repr(version))))
    content = {name: value for name, value in content.items() if value is not None or name in INDISPENSABLE}
    try:
        return RunFacts.model_validate(content), notes
    except ValidationError as error:
        wrong = {str(e["loc"][0]): e for e in error.errors() if e["loc"]}
    for name, problem in wrong.items():
        if name in INDISPENSABLE:
            where = ".".join(map(str, problem["loc"]))
            raise UserInputError(f"{path}: not a result record: {clean(where)}: {problem['msg']}")
        notes.append(f"'{name}' of its record is not understood and left out")
    kept = {name: value for name, value in content.items() if name not in wrong}
    return RunFacts.model_validate(kept), notes
