"""docs/datasets.md says what the table of dataset families and the scene keys say."""

from __future__ import annotations

import re
from dataclasses import fields
from pathlib import Path

from sw_datasets.families import BENCHMARKS
from sw_datasets.pictures import fitted_size

from splatwizard_core.scene.dataset import SceneOptions

DOCS = (Path(__file__).resolve().parents[1] / "docs" / "datasets.md").read_text(encoding="utf-8")


def rows(heading: str) -> list[list[str]]:
    """The cells of the table below a heading, without its head."""
    section = re.search(rf"^## {heading}\n(.*?)(?=^## |\Z)", DOCS, re.M | re.S)
    assert section, heading
    table = [line.strip("|").split("|") for line in section.group(1).splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in row] for row in table[2:]]


def test_the_table_of_collections_is_the_one_that_is_read_by():
    found = {row[0].strip("`"): row[1:] for row in rows("The six collections")}
    assert list(found) == list(BENCHMARKS)
    for name, (title, scenes, _, _, split, background) in found.items():
        family = BENCHMARKS[name]
        assert (title, split.strip("`"), background) == (family.title, family.split, family.background)
        assert tuple(scenes.split()) == family.scenes
    for name, (_, _, survey, inria, _, _) in found.items():
        pictures = BENCHMARKS[name].pictures
        rule = {-1: "1600 px rule", 2: "halved"}[pictures["survey"].resolution]
        assert survey == ("800x800 as it is" if pictures["survey"].folder is None else f"`images`, {rule}")
        assert (inria == "the same") == (pictures["inria"] == pictures["survey"])


def test_every_scene_key_stands_in_the_docs():
    assert {row[0].strip("`") for row in rows("Scene keys")} == {f.name for f in fields(SceneOptions)} - {"seed"}


def test_the_examples_of_the_resolution_rule_are_right():
    assert "4946x3286 becomes 1600x1063 by it, 1236x822 with 4; 1554 px stay" in DOCS
    assert fitted_size(4946, 3286, -1) == (1600, 1063)
    assert fitted_size(4946, 3286, 4) == (1236, 822)
    assert fitted_size(1554, 1036, -1) == (1554, 1036)
