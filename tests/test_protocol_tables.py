"""benchmarks/protocol_tables.py: which trainings it asks for, and that its figures are what they are called."""

from __future__ import annotations

import importlib
import json
import shutil
import sys
from argparse import Namespace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import torch

from splatwizard_core.api import UserInputError

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


def part(name: str) -> Any:
    """A fixture with one of the modules beside the script."""

    @pytest.fixture(name=name)
    def imported(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
        monkeypatch.syspath_prepend(str(BENCHMARKS))
        for each in BENCHMARKS.glob("*.py"):
            monkeypatch.delitem(sys.modules, each.stem, raising=False)
        return importlib.import_module(f"protocol_{name}")

    return imported


trainings, codecs, scores, splits = map(part, ("trainings", "codecs", "scores", "splits"))


def test_blender_scenes_are_trained_on_black_and_room_with_both_splits(trainings, tmp_path):
    (tmp_path / "lego").mkdir()
    (tmp_path / "lego" / "transforms_test.json").write_text("{}")
    cells = trainings.training_cells(tmp_path, ["lego", "room"], None)
    told = {(cell.label, cell.rate, Path(cell.scene).name, cell.sets) for cell in cells}
    assert told == {
        ("3dgs", "r6", "lego", ("background=black",)),
        *((method, rate, "room", ()) for method, rate, _ in trainings.SPLIT_METHODS),
        *(
            (f"{method}-sector", rate, "room", (f"split={trainings.SECTOR}",))
            for method, rate, _ in trainings.SPLIT_METHODS
        ),
    }
    scaled = next(cell for cell in trainings.training_cells(tmp_path, ["room"], 3000) if cell.label == "wisp")
    assert {"iterations=1800", "pretrained.iterations=3000"} <= set(scaled.sets)


def test_a_size_beside_the_anchor_is_at_the_same_psnr(codecs):
    def point(codec: str, rate: str, size: int, psnr: float | None) -> dict[str, Any]:
        return {"codec": codec, "rate": rate, "bytes": size, "psnr_rgb_pooled": psnr}

    rows = [point("gsc-quant", "r1", 100, 40.0), point("gsc-quant", "r2", 400, 50.0), point("spz", "r1", 300, 45.0)]
    assert codecs.times_anchor(rows[2], rows) == pytest.approx(300 / 200)  # half way in dB, the geometric mean in bytes
    assert codecs.times_anchor(rows[0], rows) is None
    assert codecs.times_anchor(point("spz", "r2", 300, 51.0), rows) is None


def test_a_codec_that_was_cut_off_counts_with_its_points(codecs, tmp_path):
    def row(codec: str, rate: str, size: int | None, psnr: float | None = None) -> dict[str, Any]:
        return {"sequence": "x", "codec": codec, "rate": rate, "bytes": size, "psnr_rgb_pooled": psnr, "enc_s": 1.0}

    folder = tmp_path / "gsc" / "room" / "mpeg-gsc"
    for each in (row("3dgs", "r1", 100, 40.0), row("3dgs", "r2", 200, 45.0), row("spz", "r1", 1, 1.0)):
        file = folder / "room" / each["codec"] / f"{each['rate']}.json"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps({"row": each}))
    done = [row("spz", "r1", 300, 45.0), row("spz", "r2", 300, 45.0), row("gsc-quant", "r1", None)]
    for codec in ("spz", "gsc-quant"):
        mine = [each for each in done if each["codec"] == codec]
        (folder / f"{codec}.done.json").write_text(json.dumps({"rows": mine}))
    rows = codecs.gsc_rows(Namespace(out=tmp_path))
    assert {each["sequence"] for each in rows} == {"room"}
    assert {each["enc_s"] for each in rows} == {None}
    points = [(each["codec"], each["rate"], each["bytes"]) for each in codecs.distinct(rows)]
    assert points == [
        ("gsc-quant", "r1", None), ("spz", "r1 to r2", 300), ("3dgs", "r1", 100), ("3dgs", "r2", 200),
    ]  # fmt: skip
    rates = {"3dgs": ["r1", "r2", "r3"], "spz": ["r1", "r2"], "c3dgs": ["r1"]}
    assert codecs.unfinished(rows, rates) == {"room": {"3dgs": "r3"}}
    assert codecs.reference_of(rows) == "3dgs"
    assert codecs.times_anchor(rows[1], rows) == pytest.approx(300 / 200)


def test_metrics_are_turned_so_that_higher_is_better_and_views_are_told_apart(scores, tmp_path):
    """Within each view b falls where a rises, and between views it rises with it."""
    for i in range(8):
        metrics = {
            "psnr": {"direction": "higher", "mean": 1.0, "per_view": [float(i), 100.0 + i]},
            "l1": {"direction": "lower", "mean": 1.0, "per_view": [float(i), i - 100.0]},
            "flip": {"direction": "lower", "mean": None, "per_view": [None, None]},
        }
        record = {"scene": "room", "views": ["a", "b"], "metrics": metrics,
                  "unknown": {"metrics.flip.mean": "package-missing"}}  # fmt: skip
        file = tmp_path / "scores" / "gsc" / "room" / "spz" / f"r{i}.json"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(record))
    seen = {"view": "a", **dict.fromkeys(scores.AGAINST_SOURCE), "psnr_rgb": 7.0}
    rows = [{"sequence": "room", "codec": "spz", "rate": "r3", "per_view": [seen]}]
    values, absent = scores.renders(rows, Namespace(out=tmp_path))
    assert absent == {"flip": "package-missing"}
    assert values["room", "a", "gsc/room/spz/r3.json"] == {"psnr": 3.0, "l1": -3.0, "gsc_psnr_rgb": 7.0}
    found = scores.correlate(values, "psnr", "l1")
    assert (found.n, found.views) == (16, 2)
    assert (found.within_pearson, found.within_spearman) == pytest.approx((-1.0, -1.0))
    assert found.pearson > 0.9
    assert found.spearman == pytest.approx(0.5, abs=0.01)


def test_the_fall_is_from_every_eighth_view_to_the_sector(splits, tmp_path):
    for label, views, values in (("3dgs", ["a", "b"], [30.0, 20.0]), ("3dgs-sector", ["b", "c"], [19.0, 21.0])):
        folder = splits.Cell(label, "3dgs", "room", "r6").directory(tmp_path / "train")
        folder.mkdir(parents=True)
        metric = {"mean": sum(values) / 2, "per_view": values}
        record = {"views": views, "test_views": 2, "metrics": {"psnr": metric}, "protocol": {"id": f"room/{label}"},
                  "train": {"steps": 15_000}}  # fmt: skip
        (folder / "metrics.json").write_text(json.dumps(record))
    folder = splits.Cell("cat-3dgs-sector", "cat-3dgs", "room", "r6").directory(tmp_path / "train")
    folder.mkdir(parents=True)
    (folder / "metrics.json").write_text(json.dumps(record))
    lines = splits.split_section(Namespace(out=tmp_path, data=Path()))
    assert "| 3dgs | r6 | psnr | 25.00 | 20.00 | 20.00 | 5.00 | 15,000 |" in lines
    row = "3dgs,r6,psnr,25.0,20.0,20.0,5.0,2,2,room/3dgs,room/3dgs-sector,15000,15000"
    assert row in (tmp_path / "splits.csv").read_text()
    kept = splits.recorded("cat-3dgs", "r6")["psnr"]  # of the full plan, where every eighth view is not there
    assert f"| cat-3dgs | r6 | psnr | {kept:.2f} | - | 20.00 | {kept - 20:.2f} | 40,000, sector 15,000 |" in lines
    shutil.rmtree(tmp_path / "train")
    assert lines == [*splits.split_section(Namespace(out=tmp_path, data=Path()))]  # rows stay


def test_the_page_takes_the_sections_that_there_are_and_keeps_the_others(codecs):
    page = importlib.import_module("protocol_page")
    marks = "<!-- made by benchmarks/protocol_page.py -->"
    text = f"# T\n\n{marks}\n\n## Metrics against metrics\n\nNot measured yet.\n\n"
    text += "## Every 8th view against a sector\n\nold\n\n<!-- end -->\n\ntail\n"
    made = page.filled(text, "## Every 8th view against `sector:60` on room\n\n| a |\n\n## How far\n\nnew\n")
    assert "Not measured yet." in made
    assert "| a |" in made
    assert "old" not in made
    assert made.endswith("new\n\n<!-- end -->\n\ntail\n")
    assert page.filled(made, "") == made
    assert page.MADE.search(page.PAGE.read_text()) is not None


def test_distances_are_those_of_the_cameras(codecs):
    distances = importlib.import_module("path_distances")

    def view(name: str, x: float) -> SimpleNamespace:
        camera = SimpleNamespace(R=torch.eye(3), tau=torch.tensor([-x, 0.0, 0.0]))
        return SimpleNamespace(name=name, camera=camera)

    scene = SimpleNamespace(
        test=[view("b", 1), view("d", 5)], train=[view("a", 0), view("c", 2), view("e", 4)], path="s"
    )
    record = {"views": ["b", "d"], "metrics": {"psnr": {"per_view": [30.0, 20.0]}}}
    found = distances.with_distances(record, scene)["metrics"]
    assert found["path_distance"]["per_view"] == [0.5, 0.5]
    assert found["path_angle"]["per_view"] == [0, 0]
    assert found["path_combined"]["per_view"] == pytest.approx([1 / 2.2, 1 / 2.2])  # extent 1.1 x 2
    with pytest.raises(UserInputError, match="test views are not"):
        distances.with_distances({**record, "views": ["b"]}, scene)
