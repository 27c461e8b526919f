"""`sw compare --published`: figures have a source, and what differs from a run is named."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner
from sw_report.beside_tables import beside_tables, deltas
from sw_report.compare import compare
from sw_report.published import FILE, beside, differences, read_published, steps_of
from sw_report.runs import collect

from splatwizard_core.api import UserInputError

PROTOCOL = {"id": "mipnerf360/x", "dataset": "mipnerf360", "images": "images", "resolution": -1, "split": "every8",
            "background": "black"}  # fmt: skip
STEPS = {"train_s": 1.0, "steps": 30_000, "pretraining": {}}


def written(folder: Path, scenes=("bonsai",), **changes) -> list:
    """Runs of hac r1 on scenes of Mip-NeRF 360, as they are collected."""
    for scene in scenes:
        record = {
            "method": "hac", "rate": "r1", "dataset": "mipnerf360", "scene": scene, "protocol": PROTOCOL,
            "train": STEPS, "file": {"bytes": 8_000_000},
            "metrics": {"psnr": {"mean": 32.0}, "ssim": {"mean": 0.94}, "lpips_vgg_3dgs": {"mean": 0.19}},
            "counts": {"num_gaussians": 1_000_000}, "schema_version": 1, **changes,
        }  # fmt: skip
        place = folder / scene / "hac" / str(record["rate"])
        place.mkdir(parents=True)
        (place / "metrics.json").write_text(json.dumps(record))
    return collect([folder]).runs


@pytest.fixture
def runs(tmp_path):
    return lambda **changes: written(tmp_path / "out", **changes)


def test_every_figure_says_where_it_comes_from():
    figures = read_published()
    assert len(figures) > 100
    for figure in figures:
        assert figure.source
        assert 2020 < figure.year < 2030
        assert figure.protocol.text
        assert figure.psnr is not None or figure.bytes is not None
        assert figure.psnr is None or 15 < figure.psnr < 45
        assert figure.bytes is None or 10**5 < figure.bytes < 10**9, "bytes, not megabytes"
    named = [(f.method, f.variant, f.dataset, f.scene, f.psnr) for f in figures]
    assert len(set(named)) == len(named)
    # Figures that others are made of: the mean of 3DGS's nine scenes is its published mean.
    scenes = [f.psnr for f in figures if (f.method, f.dataset) == ("3dgs", "mipnerf360") and f.scene is not None]
    assert len(scenes) == 9
    assert sum(scenes) / 9 == pytest.approx(27.21, abs=0.006)


def test_a_run_as_published_differs_in_what_nobody_can_change_alone(runs):
    (run,) = runs()
    (found,) = beside(run.facts, "bonsai", read_published())
    assert found.same_rate
    assert found.figure.bytes == 8_976_754
    assert found.differences == tuple(found.figure.differs)
    psnr, size = deltas({"psnr": 32.0, "bytes": 8_976_754 / 2}, found.figure)
    assert psnr == pytest.approx(32.0 - 32.275)
    assert size == pytest.approx(-50)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"protocol": {**PROTOCOL, "images": "images_2"}}, "images images_2 here, images there"),
        ({"protocol": {**PROTOCOL, "background": "white"}}, "background white here, black there"),
        ({"train": {**STEPS, "steps": 7000}}, "7,000 steps here, 30,000 there"),
        ({"metrics": {"psnr": {"mean": 30.0}, "ssim": {"mean": 0.9}}}, "no LPIPS here"),
    ],
)
def test_what_differs_is_named(runs, changes, told):
    (run,) = runs(**changes)
    (found,) = beside(run.facts, "bonsai", read_published())
    assert told in found.differences


def test_steps_count_those_of_the_scene_that_a_training_started_from(runs):
    (run,) = runs(train={**STEPS, "steps": 5000, "pretraining": {"3dgs": {"steps": 30_000}}})
    assert steps_of(run.facts) == 35_000
    (run,) = collect([run.directory]).runs
    figure = next(f for f in read_published() if f.method == "c3dgs" and f.dataset == "mipnerf360")
    assert not any("steps" in line for line in differences(run.facts, figure))
    assert "pictures not stated there" in differences(run.facts, figure)


def test_values_that_the_published_run_had_are_compared(runs):
    config = {"method": "hac", "config": {"growth": {"init_factor": 16}}, "scene": {"background": "white"}}
    protocol = {**PROTOCOL, "dataset": "nerf_synthetic", "split": "file", "background": "black"}
    (run,) = runs(scenes=("lego",), dataset="nerf_synthetic", config=config, protocol=protocol)
    (found,) = beside(run.facts, "lego", read_published())
    assert "growth.init_factor 16 here, 4 there" in found.differences
    assert not any(line.startswith("background") for line in found.differences), "the protocol says it"


def test_another_rate_point_stands_beside_all_of_the_method(runs):
    (run,) = runs(rate="r3")
    found = beside(run.facts, "bonsai", read_published())
    assert [each.figure.rate for each in found] == ["r1", "r5"]
    assert not any(each.same_rate for each in found)
    assert "rate point r3 here, r1 there" in found[0].differences


def test_means_are_compared_once_every_scene_is_there(runs, tmp_path):
    scenes = ("bicycle", "flowers", "garden", "stump", "treehill", "room", "counter", "kitchen", "bonsai")
    some = beside_tables(written(tmp_path / "some", scenes[:8]))
    assert not any(table.title.startswith("mean") for table in some)
    mean = beside_tables(written(tmp_path / "all", scenes))[-1]
    assert mean.title == "mean over Mip-NeRF 360, 9 scenes"
    ((_, (found,)),) = mean.groups
    assert found.figure.bytes == 16_005_406
    assert {"cat-3dgs", "mesongs"} <= {figure.method for figure in mean.others}


def test_the_command_prints_both_and_names_scenes_without_figures(runs, tmp_path):
    runs()
    done = CliRunner().invoke(compare, [str(tmp_path / "out"), "--published"])
    assert done.exit_code == 0, done.output
    assert "hac r1" in done.output
    assert "32.27" in done.output or "32.28" in done.output
    assert "results/MipNeRF360/bonsai.csv" in done.output
    assert "mesongs" in done.output
    done = CliRunner().invoke(compare, [str(tmp_path / "out"), "--published", "--own", "--json"])
    content = json.loads(done.output)
    assert content["tables"][0]["others"] == []
    assert content["tables"][0]["runs"][0]["published"][0]["year"] == 2024
    with pytest.raises(UserInputError, match=r"nothing is published for demo/demo: .*mipnerf360"):
        beside_tables(written(tmp_path / "demo", ("demo",), dataset="demo"))


def test_a_file_with_a_wrong_field_is_named(tmp_path):
    content = json.loads(FILE.read_text("utf-8"))
    wrong = tmp_path / "wrong.json"
    wrong.write_text(json.dumps({**content, "figures": [content["figures"][0], {**content["figures"][0], "psnrr": 3}]}))
    with pytest.raises(UserInputError, match=r"figure 2: psnrr"):
        read_published(wrong)
