"""Reader of result records that any release of this software, or other software, wrote.

`Record` says what there is. A report reads also what older and newer releases wrote, and files that strangers sent: it
takes what it understands, says what it does not, and invents nothing.
"""

from __future__ import annotations

import json
import unicodedata
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from splatwizard_core.api import UserInputError
from splatwizard_core.tooling import SCHEMA, Record, Shown, json_reason
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


class RunFacts(Record):
    """One record. Only method, scene, protocol, metrics and the size of the file are indispensable."""

    schema_version: int = 0

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

    def rules(self) -> dict[str, Any]:
        """Every rule of the protocol by name, without the id."""
        return self.protocol.model_dump(exclude_unset=True, exclude={"id"})

    def protocol_without_folder(self) -> str:
        """Id of all rules but the picture folder, which may differ between the scenes of one data set."""
        images, id_ = self.rules().get("images"), self.protocol.id
        return "/".join("*" if part == images else part for part in id_.split("/"))

    def all_steps(self) -> str:
        """Steps of the scenes that the training started from, or was taught by, and its own: `30,000 + 5,000`."""
        before = [numbers.count(scene.steps) if "name" not in scene.file else "file"
                  for scene in self.train.pretraining.values()]  # fmt: skip
        return " + ".join([*before, numbers.count(self.train.steps)])

    def started_from(self) -> str:
        """Trained scenes that the training started from, in words; empty if there are none."""
        found = []
        for name, scene in self.train.pretraining.items():
            steps = "" if scene.steps is None else f", {numbers.count(scene.steps)} steps"
            seconds = "" if scene.train_s is None else f", {numbers.seconds(scene.train_s)} s"
            preset = "" if scene.preset is None else f" ({scene.preset} preset{steps}{seconds})"
            origin = f" from the file {scene.file['name']}" if "name" in scene.file else preset
            found.append(f"a trained {name} scene{origin}")
        return "; ".join(found)

    def served(self) -> list[tuple[str, dict[str, list[str]]]]:
        """Each phase with its distributions -> the parts that served: `sw-codecs 0.1` -> `coder octree`."""
        found = []
        for phase in self.phases:
            parts: dict[str, list[str]] = {}
            for part in phase.provided_by:
                owner = f"{part.distribution} {part.version}".strip() or "no distribution"
                parts.setdefault(owner, []).append(f"{part.kind} {part.name}")
            found.append((phase.phase, parts))
        return found


def shown(block: BaseModel) -> Iterator[tuple[Shown, float | None, str]]:
    """Yield the fields of a record that are marked to be shown: the mark, the value, what it is."""
    for name, field in type(block).model_fields.items():
        value = getattr(block, name)
        if isinstance(value, BaseModel):
            yield from shown(value)
        for mark in field.metadata:
            if isinstance(mark, Shown):
                yield mark, value, field.description or ""


OTHER_SCHEMA = f"record of schema {{}}, this release writes {SCHEMA}: a dash may stand for what only one has"
INDISPENSABLE = ("schema_version", "method", "scene", "protocol", "file", "metrics")


def _integer(digits: str) -> int:
    if len(digits) > 20:  # no float holds one of 400 digits
        raise ValueError(f"an integer of {len(digits):,} digits")
    return int(digits)


def _cleaned(content: Any) -> Any:
    """Return the content with harmless text. Raises ValueError for a list or object of more items than any has."""
    if isinstance(content, str):
        return clean(content)
    if isinstance(content, (dict, list)) and len(content) > MOST_ITEMS:
        raise ValueError(f"a list or object of {len(content):,} items; {MOST_ITEMS:,} are the most")
    if isinstance(content, dict):
        return {clean(name): _cleaned(value) for name, value in content.items()}
    return [_cleaned(value) for value in content] if isinstance(content, list) else content


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
        content = _cleaned(content)
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
    for name in INDISPENSABLE:
        if name in wrong:
            where = ".".join(map(str, wrong[name]["loc"]))
            raise UserInputError(f"{path}: not a result record: {clean(where)}: {wrong[name]['msg']}")
    notes += [f"'{name}' of its record is not understood and left out" for name in wrong]
    kept = {name: value for name, value in content.items() if name not in wrong}
    return RunFacts.model_validate(kept), notes
