"""docs/protocol.md names every metric, every field of the record and every flag, as they are."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

from sw_metrics.lpips_weights import BACKBONES

from splatwizard_core.plugins import load_plugins
from splatwizard_core.plugins.catalogue import is_ours
from splatwizard_core.runs import measure, record
from splatwizard_core.scene.scene import Protocol

PAGE_PATH = Path(__file__).resolve().parents[1] / "docs" / "protocol.md"
PAGE = PAGE_PATH.read_text(encoding="utf-8")


def row(first: str) -> str:
    """The line of a table whose first cell has `first`."""
    found = [line for line in PAGE.splitlines() if re.match(rf"\| [^|]*`{re.escape(first)}`[^|]*\|", line)]
    assert found, f"no table row for {first}"
    return "\n".join(found)


def our_metrics() -> list[str]:
    return [entry.name for entry in load_plugins().metrics if is_ours(entry.distribution)]


def test_every_metric_has_its_row_with_direction_and_kind():
    for name in our_metrics():
        declared = load_plugins().metrics.entry(name).declared
        assert declared["direction"] in row(name)
        assert ("*diagnostic.*" in row(name)) == bool(declared.get("diagnostic")), name


def test_no_row_describes_a_metric_that_is_not_there():
    section = PAGE.partition("## 3 Image metrics")[2].partition("\n## ")[0].partition("Diagnostics are")[0]
    assert re.findall(r"^\| `(\w+)` \|", section, re.M) == list(
        dict.fromkeys(re.findall(r"^\| `(\w+)` \|", section, re.M))
    )
    assert set(re.findall(r"^\| `(\w+)` \|", section, re.M)) == set(our_metrics())


def test_the_table_of_the_record_is_made_from_its_declarations():
    script = PAGE_PATH.parents[1] / "tools" / "record_docs.py"
    generate = runpy.run_path(str(script))["generate"]
    assert generate(PAGE) == PAGE, "docs/protocol.md is old: `make docs`"
    assert "| `train.peak_bytes` | integer or null | over the loop;" in PAGE


def test_the_schema_and_the_flags_are_the_ones_that_are_written():
    assert f"schema {record.SCHEMA}" in PAGE
    source = Path(measure.__file__).read_text()
    flags = re.findall(r'"([a-z-]+)": ', source.partition("told = {")[2].partition("}")[0])
    assert flags
    assert set(re.findall(r"`([\w-]+)`", row("flags").split("|")[3])) == set(flags)


def test_the_example_of_an_id_is_what_a_scene_of_that_kind_gets():
    assert f"    {Protocol('mipnerf360').id}\n" in PAGE
    assert Protocol("x", masked=True, composite8=True).id.endswith("/masked/composite8")


def test_the_files_of_weights_are_named_as_they_are_looked_for():
    for backbone in BACKBONES.values():
        assert backbone.address in row(backbone.file_name)
