"""PSNR over the training views: what the record holds of it."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from splatwizard_core.plugins import PluginManager
from splatwizard_core.runs.config import parse_set, resolve
from splatwizard_core.runs.directory import RunRequest
from splatwizard_core.runs.record import Record, read_record
from splatwizard_core.runs.run import run
from splatwizard_core.runs.session import Session
from splatwizard_core.runs.training_views import summary, training_psnr
from splatwizard_core.scene.camera import Camera
from splatwizard_core.scene.scene import Protocol, Scene, View

CPU = torch.device("cpu")


def views(*grey: int) -> list[View]:
    """Pictures of one grey each, 4x3."""
    camera = Camera(4, 3, 10.0, 10.0, 2.0, 1.5, torch.eye(3), torch.zeros(3))
    return [View(camera, f"{i}.png", lambda g=g: np.full((3, 4, 3), g, np.uint8)) for i, g in enumerate(grey)]


def of_black_model(*grey: int) -> tuple[Any, dict[str, str]]:
    """Black renders against such training pictures: a view has -20 log10(grey / 255) dB."""
    scene = Scene("s", views(*grey), [], None, Protocol("x"))
    return training_psnr(scene, lambda camera: torch.zeros(3, camera.height, camera.width), CPU)


def test_mean_median_and_quantile_are_those_of_the_views():
    found, reasons = of_black_model(51, 26, 51, 128)
    one, ten, half = (-20 * math.log10(g / 255) for g in (51, 26, 128))
    assert found.model_dump() == {
        "mean": pytest.approx((2 * one + ten + half) / 4), "median": pytest.approx(one),
        "quantile_05": pytest.approx(half), "far_below": {},
    }  # fmt: skip
    assert reasons == {}


def test_the_quantile_is_a_view_that_at_least_five_percent_lie_at_or_below():
    found, _ = summary({str(i): float(i) for i in range(1, 61)})
    assert (found.quantile_05, found.median, found.mean) == (3.0, 30.5, 30.5)
    assert summary({"a": 7.0})[0].quantile_05 == 7.0


def test_renders_are_rounded_to_8_bit_as_the_test_views_are_and_no_picture_is_kept():
    scene = Scene("s", views(100), [], None, Protocol("x"))
    found, _ = training_psnr(scene, lambda camera: torch.full((3, 3, 4), 100.4 / 255), CPU)
    assert found.mean is None  # identical after rounding
    assert not any("pixels" in vars(view) for view in scene.train)


def test_views_far_below_the_median_are_named_lowest_first():
    found, _ = summary({"a": 30.0, "e": 21.9, "c": 22.0, "d": 31.0, "b": 12.0, "f": 30.0, "g": 32.0})
    assert found.median == 30.0
    assert list(found.far_below.items()) == [("b", 12.0), ("e", 21.9)]  # 22.0 is 8 dB below, not more


def test_what_is_not_finite_is_null_with_its_reason():
    found, reasons = summary({"a": math.inf, "b": 30.0, "c": 29.0})
    assert (found.mean, found.median, found.quantile_05) == (None, 30.0, 29.0)
    assert list(reasons) == ["training_psnr.mean"]
    assert "identical" in reasons["training_psnr.mean"]
    found, reasons = summary({"a": math.inf, "b": math.inf, "c": 29.0})
    assert (found.median, found.far_below) == (None, {})
    assert summary({"a": math.nan, "b": 30.0})[0] is None
    assert "not a number" in summary({"a": math.nan, "b": 30.0})[1]["training_psnr"]
    assert of_black_model() == (None, {"training_psnr": "the scene has no training views"})


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("out")


@pytest.mark.pipeline
class TestRun:
    """Through the whole chain, on the tiny scene."""

    @staticmethod
    def go(plugins: PluginManager, out: Path, *sets: str) -> tuple[Record, Path, list[str]]:
        said: list[str] = []
        resolved = resolve(plugins.methods.load("toy"), rate="r1", sets=parse_set(sets), scene="demo:tiny")
        record, directory = run(Session(plugins, CPU, said.append), RunRequest(resolved, out))
        return record, directory, said

    def test_the_record_has_it_from_the_decoded_model(self, toy_plugins: PluginManager, out: Path):
        from splatwizard_core.evaluation.evaluate import evaluate, render_options
        from splatwizard_core.runs.decode import open_model

        record, directory, _ = self.go(toy_plugins, out)
        model, reader = open_model(directory / "scene.swz", toy_plugins, CPU)
        resolved = resolve(toy_plugins.methods.load("toy"), rate="r1", scene="demo:tiny")
        session = Session(toy_plugins, CPU, lambda line: None)
        scene = session.scene(resolved)
        expected = evaluate(
            model, scene.train, session.rasterizer(resolved, ()), toy_plugins, device=CPU,
            options=render_options(reader.raster, scene.background), metrics=["psnr"],
        ).metrics["psnr"]  # fmt: skip
        assert record.training_psnr is not None
        assert record.training_psnr.mean == pytest.approx(expected.mean, abs=1e-9)
        assert record.training_psnr.quantile_05 == pytest.approx(min(expected.per_view), abs=1e-9)
        assert read_record(directory / "metrics.json") == record

    def test_it_can_be_left_out_and_what_is_there_is_kept(self, toy_plugins: PluginManager, tmp_path: Path):
        record, _, _ = self.go(toy_plugins, tmp_path, "eval_train=false")
        assert record.training_psnr is None
        assert "eval_train" in record.unknown["training_psnr"]
        asked, _, said = self.go(toy_plugins, tmp_path)
        assert asked.training_psnr is not None
        assert not any(line.startswith(("training toy", "encoded", "decoded")) for line in said)  # evaluated alone
        assert asked.metrics["psnr"] == record.metrics["psnr"]
        assert self.go(toy_plugins, tmp_path, "eval_train=false")[0].training_psnr == asked.training_psnr
