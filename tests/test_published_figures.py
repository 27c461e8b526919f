"""Published figures that our packages bring: each has a source, and means agree with the scenes they are made of."""

from __future__ import annotations

import sys
import zipfile
from collections import defaultdict
from pathlib import Path

import pytest
from sw_report.declared import dataset_facts
from sw_report.published_files import Figure, published_by, read_published

from splatwizard_core.plugins import load_plugins
from splatwizard_core.runs.config import parse_set, resolve

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[1]
SWAPPED = {("hemgs", "nerf_synthetic")}  # the source's mean has the labels of one scene swapped


def test_every_figure_says_where_it_comes_from():
    figures = read_published()
    assert len(figures) > 350
    for figure in figures:
        assert figure.source
        assert 2020 < figure.year < 2030
        assert figure.psnr is not None or figure.bytes is not None
        assert figure.psnr is None or 15 < figure.psnr < 45
        assert figure.bytes is None or 10**5 < figure.bytes < 10**9, "bytes, not megabytes"
    named = [(f.method, f.variant, f.dataset, f.scene, f.psnr) for f in figures]
    assert len(set(named)) == len(named)


@pytest.mark.parametrize("word", ["recalled", "transcribed", "quoted", "copy", "not re-read"])
def test_what_is_second_hand_is_not_called_verified(word):
    for figure in read_published():
        if word in figure.source:
            assert not figure.verified, figure


@pytest.mark.parametrize("name", ["psnr", "ssim", "lpips", "bytes", "gaussians"])
def test_a_mean_is_that_of_its_scenes_to_the_digits_that_are_printed(name):
    scenes: dict[tuple[str, str, str], list[Figure]] = defaultdict(list)
    for figure in read_published():
        if figure.scene is not None:
            scenes[figure.method, figure.variant, figure.dataset].append(figure)
    compared = 0
    for figure in read_published():
        rows = scenes[figure.method, figure.variant, figure.dataset]
        values = [getattr(row, name) for row in rows]
        whole = sorted(filter(None, (row.scene for row in rows))) == sorted(dataset_facts(figure.dataset).scenes)
        printed = getattr(figure, name)
        if figure.scene is None and whole and None not in (printed, *values):
            if (figure.method, figure.dataset) in SWAPPED:
                assert figure.differs
                continue
            digits = len(str(printed).partition(".")[2]) if isinstance(printed, float) else 0
            step = 0.01 if name == "psnr" and digits < 2 else 10.0**-digits
            step = 10_000 if any("rounded" in text for text in figure.differs) and name == "bytes" else step
            assert sum(values) / len(values) == pytest.approx(printed, abs=0.6 * max(step, 0.001)), figure
            compared += 1
    assert compared >= {"lpips": 12, "gaussians": 3}.get(name, 10)


def test_a_package_brings_the_figures_of_its_own_methods():
    entries = [entry for entry in load_plugins().methods if "published" in entry.declared]
    assert len(entries) >= 11
    for entry in entries:
        package, _, file = entry.declared["published"].partition(":")
        assert package == entry.target.partition(".")[0]
        text = (ROOT / "plugins" / entry.distribution / "src" / package / file).read_text("utf-8")
        assert "tables" in tomllib.loads(text)
        assert {figure.method for figure in published_by(entry)} == {entry.name}


def test_the_rows_that_can_be_run_name_what_we_have():
    plugins = load_plugins()
    for figure in read_published():
        if figure.method in plugins.methods:
            method = plugins.methods.load(figure.method)
            assert figure.rate in method.RATES, "every published rate has a name of ours"
            if figure.preset is not None:
                sets = parse_set(figure.sets)
                resolve(method, figure.preset, figure.rate, sets=sets, scene="demo:tiny", plugins=plugins)
                assert figure.scene is not None
        else:
            assert figure.rate is None
            assert figure.preset is None


def test_chair_has_both_rates_of_hac_plus():
    rows = [f for f in read_published() if (f.method, f.scene) == ("hac-plus", "chair")]
    assert [(f.rate, f.bytes, f.preset) for f in rows] == [("r1", 685_349, "paper"), ("r5", 1_719_769, "paper")]


@pytest.mark.parametrize("package", ["sw-hac", "sw-report"])
def test_a_wheel_holds_its_figures(package, tmp_path):
    build = pytest.importorskip("hatchling.builders.wheel")
    builder = build.WheelBuilder(str(ROOT / "plugins" / package))
    (wheel,) = builder.build(directory=str(tmp_path), versions=["standard"])
    inside = {name.rpartition("/")[2] for name in zipfile.ZipFile(wheel).namelist()}
    expected = {"sw-hac": {"published.toml"}, "sw-report": {"published_others.toml", "protocols.toml"}}[package]
    assert expected <= inside
