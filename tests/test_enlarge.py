"""benchmarks/enlarge.py: cameras, key points and pictures grow together; lenses with distortion are refused."""

import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from sw_datasets.loaders.colmap_model import (
    ColmapCamera,
    ColmapImage,
    ColmapModel,
    ColmapPoints,
    read_model,
    write_model,
)

from splatwizard_core.plugins.manager import load_plugins
from splatwizard_core.scene.dataset import SceneOptions
from splatwizard_core.scene.loading import load_scene

SCRIPT = Path(__file__).parents[1] / "benchmarks" / "enlarge.py"


def write_scene(
    folder: Path,
    model: str = "PINHOLE",
    params: tuple[float, ...] = (20.0, 21.0, 8.0, 6.0),
    picture: str = "a/0.jpg",
    color: tuple[int, ...] = (200, 100, 50),
) -> Path:
    camera = ColmapCamera(1, model, 16, 12, params)
    image = ColmapImage(1, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 1, picture, np.array([[3.5, 4.5]]), np.array([1]))
    points = ColmapPoints(
        np.array([1]), np.array([[0.0, 0.0, 2.0]]), np.array([[9, 8, 7]], np.uint8), np.array([0.5]),
        np.array([0, 1]), np.array([[1, 0]], np.int32),
    )  # fmt: skip
    write_model(ColmapModel({1: camera}, {1: image}, points), folder / "sparse" / "0")
    (folder / "images" / "a").mkdir(parents=True)
    Image.new("RGBA" if len(color) == 4 else "RGB", (16, 12), color).save(folder / "images" / picture)
    return folder


@pytest.fixture
def run(monkeypatch, capsys):
    """run(*words): the status of the script, and what it says on stderr."""

    def run(*words: object) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", [str(SCRIPT), *map(str, words)])
        status = 0
        try:
            runpy.run_path(str(SCRIPT), run_name="__main__")
        except SystemExit as end:
            status = int(end.code or 0)
        return status, capsys.readouterr().err

    return run


def test_all_of_a_scene_grows(run, tmp_path):
    scene, out = write_scene(tmp_path / "scene"), tmp_path / "out"
    assert run(scene, out, "--factor", 3)[0] == 0
    model = read_model(out / "sparse" / "0")
    assert model.cameras[1] == ColmapCamera(1, "PINHOLE", 48, 36, (60.0, 63.0, 24.0, 18.0))
    assert model.images[1].xys.tolist() == [[10.5, 13.5]]
    assert model.points.xyz.tolist() == [[0, 0, 2]]
    with Image.open(out / "images" / "a" / "0.jpg") as picture:
        assert picture.size == (48, 36)
        assert np.abs(np.asarray(picture, int) - (200, 100, 50)).max() < 4
    assert load_scene(str(out), SceneOptions(split="all"), load_plugins()).train[0].camera.width == 48


def test_pictures_keep_their_alpha(run, tmp_path):
    scene, out = write_scene(tmp_path / "scene", picture="a/0.png", color=(200, 100, 50, 128)), tmp_path / "out"
    assert run(scene, out)[0] == 0
    with Image.open(out / "images" / "a" / "0.png") as picture:
        assert picture.size == (32, 24)
        assert picture.mode == "RGBA"
        # Colours are resized times alpha, and rounded twice.
        assert np.abs(np.asarray(picture, int) - (200, 100, 50, 128)).max() <= 1


def test_what_cannot_be_done_is_one_line(run, tmp_path):
    scene = write_scene(tmp_path / "scene", "SIMPLE_RADIAL", (20.0, 8.0, 6.0, 0.1))
    status, told = run(scene, tmp_path / "out")
    assert status == 1
    assert "sw data undistort" in told
    assert told.count("\n") == 1
    assert not (tmp_path / "out").exists()
    assert "is there already" in run(scene, scene)[1]
    assert run(scene, tmp_path / "out", "--factor", 1)[0] == 2
    lacking = write_scene(tmp_path / "lacking")
    (lacking / "images" / "a" / "0.jpg").unlink()
    status, told = run(lacking, tmp_path / "out")
    assert status == 1
    assert "0.jpg" in told


@pytest.mark.parametrize("broken", ["sparse/0/cameras.bin", "images/a/0.jpg"])
def test_nothing_is_left_of_a_scene_that_lacks_something(tmp_path, broken):
    scene = write_scene(tmp_path / "scene")
    (scene / broken).unlink()
    enlarge = runpy.run_path(str(SCRIPT))["enlarge"]
    with pytest.raises(Exception, match=r"cameras|0\.jpg"):
        enlarge(scene, tmp_path / "out", 2)
    assert not (tmp_path / "out").exists()
