"""Undistorting, by reprojection: dots are drawn where a distorted lens sees known points, by formulas of this file;
after undistorting, the loader's pinhole camera must find each dot where it projects the point.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from sw_datasets.loaders.colmap import pose
from sw_datasets.loaders.colmap_model import (
    ColmapCamera,
    ColmapImage,
    ColmapModel,
    ColmapPoints,
    read_model,
    write_model,
)
from sw_datasets.undistort import full_rectangle, undistort_scene

from splatwizard_core.cli.main import main
from splatwizard_core.errors import SceneError
from splatwizard_core.plugins import load_plugins
from splatwizard_core.scene.dataset import SceneOptions
from splatwizard_core.scene.loading import load_scene

pytest.importorskip("pycolmap", reason="pip install 'sw-datasets[pycolmap]'")

WIDTH, HEIGHT = 240, 180
SIGMA = 2.0  # px of a dot; wide enough that its centre is exact to a hundredth of a pixel
GREY = 60.0  # of the ground, so that a black border would show


def radial(x, y, k1, k2, p1, p2):
    """Brown's model, as COLMAP's OPENCV states it."""
    r2 = x * x + y * y
    ring = 1 + k1 * r2 + k2 * r2 * r2
    return x * ring + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * ring + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)


def fisheye(x, y, k1, k2, k3, k4):
    """Equidistant projection with a polynomial in the angle."""
    r = np.hypot(x, y)
    a = np.arctan(r)
    bent = a * (1 + k1 * a**2 + k2 * a**4 + k3 * a**6 + k4 * a**8)
    scale = np.divide(bent, r, out=np.ones_like(r), where=r > 1e-12)
    return x * scale, y * scale


def field_of_view(x, y, omega):
    """Devernay and Faugeras's FOV model."""
    r = np.hypot(x, y)
    bent = np.arctan(2 * r * np.tan(omega / 2)) / omega
    scale = np.divide(bent, r, out=np.full_like(r, 2 * np.tan(omega / 2) / omega), where=r > 1e-12)
    return x * scale, y * scale


def rational(x, y, k1, k2, p1, p2, k3, k4, k5, k6):
    """COLMAP's FULL_OPENCV."""
    r2 = x * x + y * y
    ring = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    return x * ring + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * ring + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)


def thin_prism(x, y, k1, k2, p1, p2, k3, k4, sx1, sy1):
    """COLMAP's THIN_PRISM_FISHEYE: tangential and prism terms on the equidistant image plane."""
    r = np.hypot(x, y)
    flat = np.divide(np.arctan(r), r, out=np.ones_like(r), where=r > 1e-12)
    u, v = x * flat, y * flat
    r2 = u * u + v * v
    ring = k1 * r2 + k2 * r2**2 + k3 * r2**3 + k4 * r2**4
    du = u * ring + 2 * p1 * u * v + p2 * (r2 + 2 * u * u) + sx1 * r2
    dv = v * ring + 2 * p2 * u * v + p1 * (r2 + 2 * v * v) + sy1 * r2
    return u + du, v + dv


Bend = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
CENTRED = (WIDTH / 2, HEIGHT / 2)
LENSES: dict[str, tuple[tuple[float, ...], tuple[float, float, float, float], Bend]] = {
    # model -> (its parameters, the same fx fy cx cy, the lens)
    "SIMPLE_RADIAL": ((200, 118, 93, -0.2), (200, 200, 118, 93), lambda x, y: radial(x, y, -0.2, 0, 0, 0)),
    "RADIAL": ((200, 120, 90, 0.15, -0.03), (200, 200, 120, 90), lambda x, y: radial(x, y, 0.15, -0.03, 0, 0)),
    "OPENCV": (
        (200, 205, 120, 90, -0.2, 0.05, 2e-3, -3e-3), (200, 205, 120, 90),
        lambda x, y: radial(x, y, -0.2, 0.05, 2e-3, -3e-3),
    ),
    "OPENCV_FISHEYE": (
        (150, 152, 120, 90, 0.03, -0.01, 2e-3, 1e-3), (150, 152, 120, 90),
        lambda x, y: fisheye(x, y, 0.03, -0.01, 2e-3, 1e-3),
    ),
    "FULL_OPENCV": (
        (200, 205, 120, 90, -0.2, 0.05, 1e-3, 1e-3, 0.01, 0.02, 0.01, 0.0), (200, 205, 120, 90),
        lambda x, y: rational(x, y, -0.2, 0.05, 1e-3, 1e-3, 0.01, 0.02, 0.01, 0.0),
    ),
    "FOV": ((200, 205, 120, 90, 0.8), (200, 205, 120, 90), lambda x, y: field_of_view(x, y, 0.8)),
    "SIMPLE_RADIAL_FISHEYE": ((150, 120, 90, 0.02), (150, 150, 120, 90), lambda x, y: fisheye(x, y, 0.02, 0, 0, 0)),
    "RADIAL_FISHEYE": ((150, 120, 90, 0.02, 0.01), (150, 150, 120, 90), lambda x, y: fisheye(x, y, 0.02, 0.01, 0, 0)),
    "THIN_PRISM_FISHEYE": (
        (150, 152, 120, 90, 0.01, 0.005, 1e-3, -1e-3, 0.0, 0.0, 4e-3, 0.0), (150, 152, 120, 90),
        lambda x, y: thin_prism(x, y, 0.01, 0.005, 1e-3, -1e-3, 0.0, 0.0, 4e-3, 0.0),
    ),
}  # fmt: skip

POINTS = np.array([[x, y, 4 + 0.3 * x] for x in (-1.5, -0.5, 0.5, 1.5) for y in (-1.0, 0.0, 1.0)])
"""Before cameras that stand near the origin and look along +z; the outer ones lie near the edge of the picture."""

VIEWS = {
    "left/same name.png": ((0.999, 0.01, -0.03, 0.005), (0.05, 0.1, 0.0)),
    "right/same name.png": ((0.998, -0.02, 0.04, -0.03), (-0.1, -0.05, 0.2)),
}


def seen(model: str, qvec, tvec, size=(WIDTH, HEIGHT)) -> np.ndarray:
    """[P,2] pixels at which the distorted lens sees the points."""
    _, (fx, fy, cx, cy), bend = LENSES[model]
    R, tau = pose(ColmapImage(1, qvec, tvec, 1, "", np.empty((0, 2)), np.empty(0, np.int64)))
    rays = POINTS @ R.double().numpy().T + tau.double().numpy()
    x, y = bend(rays[:, 0] / rays[:, 2], rays[:, 1] / rays[:, 2])
    return np.stack([fx * x + cx, fy * y + cy], axis=1) * np.array(size) / [WIDTH, HEIGHT]


def dots(at: np.ndarray, size=(WIDTH, HEIGHT)) -> np.ndarray:
    """uint8 [H,W]: a Gaussian dot at each place, on grey; pixel (i, j) has its centre at (i + 0.5, j + 0.5)."""
    columns, rows = np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5
    bright = np.full((size[1], size[0]), GREY)
    for u, v in at:
        bright += 180 * np.exp(-((rows[:, None] - v) ** 2 + (columns - u) ** 2) / (2 * SIGMA**2))
    return bright.clip(0, 255).round().astype(np.uint8)


def write_scene(root: Path, model: str, *, size=(WIDTH, HEIGHT), channels: int = 3, suffix: str | None = None) -> Path:
    """A scene of two views by one distorted camera; its files may have another size than the camera."""
    camera = ColmapCamera(7, model, WIDTH, HEIGHT, tuple(map(float, LENSES[model][0])))
    images = {}
    for i, (name, (q, t)) in enumerate(VIEWS.items(), 1):
        q = tuple(np.array(q) / np.linalg.norm(q))
        at = seen(model, q, t)
        name = name if suffix is None else name.replace(".png", suffix)
        images[i] = ColmapImage(i, q, t, 7, name, at, np.arange(1, len(POINTS) + 1))
        pixels = dots(seen(model, q, t, size), size)
        file = root / "images" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(pixels if channels == 1 else np.dstack([pixels] * channels)).save(file)
    n = len(POINTS)
    track = np.stack([np.tile([1, 2], n), np.repeat(np.arange(n), 2)], axis=1).astype(np.int32)
    points = ColmapPoints(
        np.arange(1, n + 1), POINTS, np.full((n, 3), 200, np.uint8), np.full(n, 0.5), 2 * np.arange(n + 1), track
    )
    write_model(ColmapModel({7: camera}, images, points), root / "sparse" / "0")
    return root


def dot_centre(picture: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Centre of gravity of what is brighter than the ground within 3 sigma of a place, iterated onto the dot."""
    for _ in range(4):
        rows, columns = np.mgrid[: picture.shape[0], : picture.shape[1]] + 0.5
        weight = (picture - GREY).clip(2) - 2  # 2: rounding of the ground
        weight = weight * (np.hypot(columns - near[0], rows - near[1]) < 4 * SIGMA)
        near = np.array([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum()
    return near


def worst_reprojection(out: Path) -> tuple[float, int]:
    """(pixels between a projected point and its dot at most, dots looked at), of the views as our loader reads them."""
    scene = load_scene(f"colmap:{out}", SceneOptions(principal_point="file", split="all"), load_plugins())
    assert len(scene.train) == len(VIEWS)
    worst, count = 0.0, 0
    for view in scene.train:
        c = view.camera
        rays = POINTS @ c.R.double().numpy().T + c.tau.double().numpy()
        at = rays[:, :2] / rays[:, 2:] * [c.fx, c.fy] + [c.cx, c.cy]
        picture = view.pixels[0].numpy().astype(float)
        assert picture.shape == (c.height, c.width)
        inside = (at > 4 * SIGMA).all(1) & (at < np.array([c.width, c.height]) - 4 * SIGMA).all(1)
        for place in at[inside]:
            worst = max(worst, float(np.abs(dot_centre(picture, place) - place).max()))
            count += 1
    return worst, count


@pytest.mark.parametrize("model", LENSES)
def test_points_project_onto_their_pixels(model: str, tmp_path: Path):
    scene = write_scene(tmp_path / "in", model)
    done = undistort_scene(scene, tmp_path / "out")
    assert (done.images, done.undistorted, done.cameras, done.points) == (2, 2, 1, len(POINTS))
    worst, count = worst_reprojection(tmp_path / "out")
    assert count >= 12  # half of the dots and more stay in the picture
    assert worst < 0.15  # px; bilinear resampling of a dot of 2 px moves it by less
    before = read_model(scene / "sparse" / "0")
    after = read_model(tmp_path / "out" / "sparse" / "0")
    assert [image.name for image in after.images.values()] == list(VIEWS)
    for i, image in before.images.items():
        assert (after.images[i].qvec, after.images[i].tvec) == (image.qvec, image.tvec)
        assert (after.images[i].point_ids == image.point_ids).all()
    assert (after.points.xyz == POINTS).all()
    assert (after.points.track == before.points.track).all()


@pytest.mark.parametrize("model", LENSES)
def test_no_pixel_of_a_black_border_is_left(model: str, tmp_path: Path):
    undistort_scene(write_scene(tmp_path / "in", model), tmp_path / "out")
    for name in VIEWS:
        assert np.asarray(Image.open(tmp_path / "out" / "images" / name)).min() >= GREY - 1


@pytest.mark.parametrize("model", ["OPENCV", "SIMPLE_RADIAL_FISHEYE"])
def test_pictures_cameras_and_key_points_are_those_of_colmaps_own_undistorter(model: str, tmp_path: Path):
    import pycolmap

    scene = write_scene(tmp_path / "in", model)
    undistort_scene(scene, tmp_path / "ours")
    options = pycolmap.UndistortCameraOptions()
    options.blank_pixels = 0
    theirs = tmp_path / "theirs"
    pycolmap.undistort_images(theirs, scene / "sparse" / "0", scene / "images", undistort_options=options)
    ours, expected = read_model(tmp_path / "ours" / "sparse" / "0"), read_model(theirs / "sparse")
    assert ours.cameras == expected.cameras
    by_name = {image.name: image for image in expected.images.values()}
    for image in ours.images.values():
        assert np.abs(image.xys - by_name[image.name].xys).max() < 1e-9
        pixels, others = (np.asarray(Image.open(f / "images" / image.name)) for f in (tmp_path / "ours", theirs))
        assert (pixels == others).all()


def test_a_scene_taken_for_pinhole_would_miss_its_dots(tmp_path: Path):
    """The oracle can fail: with the coefficients struck out, points and dots lie pixels apart."""
    scene = write_scene(tmp_path / "in", "SIMPLE_RADIAL")
    model = read_model(scene / "sparse" / "0")
    plain = ColmapCamera(7, "SIMPLE_PINHOLE", WIDTH, HEIGHT, model.cameras[7].params[:3])
    write_model(ColmapModel({7: plain}, model.images, model.points), scene / "sparse" / "0")
    assert worst_reprojection(scene)[0] > 1


@pytest.mark.parametrize("size", [(121, 90), (480, 359)])
def test_files_of_another_size_than_the_camera_give_cameras_of_their_size(size: tuple[int, int], tmp_path: Path):
    undistort_scene(write_scene(tmp_path / "in", "SIMPLE_RADIAL", size=size), tmp_path / "out")
    worst, count = worst_reprojection(tmp_path / "out")
    assert worst < 0.2
    assert count >= 10


def test_key_points_move_with_the_pixels(tmp_path: Path):
    undistort_scene(write_scene(tmp_path / "in", "OPENCV"), tmp_path / "out")
    model = read_model(tmp_path / "out" / "sparse" / "0")
    fx, fy, cx, cy = model.cameras[7].params
    for image in model.images.values():
        R, tau = pose(image)
        rays = POINTS @ R.double().numpy().T + tau.double().numpy()
        expected = rays[:, :2] / rays[:, 2:] * [fx, fy] + [cx, cy]
        assert np.abs(image.xys - expected).max() < 1e-3  # px; float32 rotations


@pytest.mark.parametrize(("suffix", "channels"), [(".JPG", 3), (".webp", 3), (".tiff", 1), (".png", 4)])
def test_names_formats_and_alpha_stay(suffix: str, channels: int, tmp_path: Path):
    scene = write_scene(tmp_path / "in", "OPENCV", suffix=suffix, channels=channels)
    undistort_scene(scene, tmp_path / "out")
    before = sorted(p.relative_to(scene / "images") for p in (scene / "images").rglob("*.*"))
    assert (
        sorted(p.relative_to(tmp_path / "out" / "images") for p in (tmp_path / "out" / "images").rglob("*.*")) == before
    )
    for name in before:
        with Image.open(scene / "images" / name) as old, Image.open(tmp_path / "out" / "images" / name) as new:
            assert new.format == old.format
            assert ("A" in new.mode) == (channels == 4)
            if channels == 4:
                alpha = np.asarray(new).astype(int)
                assert np.abs(alpha[..., 3] - alpha[..., 0]).max() <= 1  # written equal, moved equally
    assert worst_reprojection(tmp_path / "out")[0] < 0.3  # JPEG adds its own error


def test_masks_move_with_the_pixels(tmp_path: Path):
    scene = write_scene(tmp_path / "in", "SIMPLE_RADIAL")
    for name in VIEWS:
        file = scene / "masks" / f"{name}.png"
        file.parent.mkdir(parents=True, exist_ok=True)
        pixels = np.asarray(Image.open(scene / "images" / name))[..., 0]
        Image.fromarray(((pixels > 150) * 255).astype(np.uint8)).save(file)
    assert undistort_scene(scene, tmp_path / "out").masks == 2
    loaded = load_scene(f"colmap:{tmp_path / 'out'}", SceneOptions(split="all"), load_plugins())
    for view in loaded.train:
        assert view.mask is not None
        bright = view.pixels[0] > 150
        assert (view.mask & bright).sum() > 0.75 * max(view.mask.sum(), bright.sum())  # rims of dots of 9 px


def test_pinhole_pictures_of_a_mixed_scene_are_copied_byte_for_byte(tmp_path: Path):
    scene = write_scene(tmp_path / "in", "OPENCV")
    model = read_model(scene / "sparse" / "0")
    plain = ColmapCamera(9, "PINHOLE", WIDTH, HEIGHT, (200.0, 200.0, 120.0, 90.0))
    images = dict(model.images)
    old = images[2]
    images[2] = ColmapImage(2, old.qvec, old.tvec, 9, old.name, old.xys, old.point_ids)
    write_model(ColmapModel({**model.cameras, 9: plain}, images, model.points), scene / "sparse" / "0")
    done = undistort_scene(scene, tmp_path / "out")
    assert (done.undistorted, done.cameras) == (1, 2)
    name = old.name
    assert (tmp_path / "out" / "images" / name).read_bytes() == (scene / "images" / name).read_bytes()
    after = read_model(tmp_path / "out" / "sparse" / "0")
    assert after.cameras[9] == plain
    assert (after.images[2].xys == old.xys).all()


def test_the_worst_edges_are_cut_until_every_pixel_is_filled():
    filled = np.ones((10, 20), bool)
    filled[:2, :] = False
    filled[:, 17:] = False
    filled[9, 0] = False
    left, top, right, bottom = full_rectangle(filled)
    assert filled[top:bottom, left:right].all()
    assert (right - left) * (bottom - top) >= 7 * 17 - 9  # one more row or column for the corner
    hole = np.ones((9, 9), bool)
    hole[4, 4] = False
    left, top, right, bottom = full_rectangle(hole)
    assert (right - left) * (bottom - top) == 0


def spoilt(scene: Path, **changes) -> Path:
    model = read_model(scene / "sparse" / "0")
    camera = model.cameras[7]
    values = {"model": camera.model, "width": WIDTH, "height": HEIGHT, "params": camera.params, **changes}
    write_model(ColmapModel({7: ColmapCamera(7, **values)}, model.images, model.points), scene / "sparse" / "0")
    return scene


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"params": (200.0, 120.0, 90.0, -4.0)}, "cannot be undistorted"),
        ({"params": (200.0, 120.0, 90.0, float("nan"))}, "makes no sense"),
        ({"params": (-200.0, 120.0, 90.0, 0.1)}, "makes no sense"),
        ({"width": 0}, "makes no sense"),
        ({"params": (200.0, 120.0, 90.0, 0.0)}, "nothing to undistort"),
        ({"model": "PINHOLE", "params": (200.0, 200.0, 120.0, 90.0)}, "nothing to undistort"),
    ],
)
def test_what_cannot_be_undistorted_says_so_and_writes_nothing(changes: dict, message: str, tmp_path: Path):
    scene = spoilt(write_scene(tmp_path / "in", "SIMPLE_RADIAL"), **changes)
    with pytest.raises(SceneError, match=message):
        undistort_scene(scene, tmp_path / "out")
    assert os.listdir(tmp_path) == ["in"]


def test_a_broken_picture_half_way_leaves_nothing(tmp_path: Path):
    scene = write_scene(tmp_path / "in", "OPENCV")
    last = scene / "images" / list(VIEWS)[-1]
    last.write_bytes(last.read_bytes()[:200])  # the header is whole
    with pytest.raises(SceneError, match="cannot be decoded"):
        undistort_scene(scene, tmp_path / "out")
    assert os.listdir(tmp_path) == ["in"]


def test_the_command_tells_what_it_did_and_refuses_a_folder_that_is_there(tmp_path: Path, capsys):
    scene, out = write_scene(tmp_path / "in", "OPENCV"), tmp_path / "out"
    assert main(["data", "undistort", str(scene), str(out), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts == {
        "scene": str(scene), "folder": str(out), "images": 2, "undistorted": 2, "masks": 0, "cameras": 1,
        "points": len(POINTS),
    }  # fmt: skip
    assert main(["data", "undistort", str(scene), str(out)]) == 2
    assert "is there already" in capsys.readouterr().err
    assert main(["data", "undistort", str(tmp_path), str(tmp_path / "new")]) == 2
    assert "only COLMAP scenes" in capsys.readouterr().err


def test_without_pycolmap_the_command_names_what_to_install(tmp_path: Path, capsys, monkeypatch: pytest.MonkeyPatch):
    scene = write_scene(tmp_path / "in", "OPENCV")
    monkeypatch.setitem(__import__("sys").modules, "pycolmap", None)
    assert main(["data", "undistort", str(scene), str(tmp_path / "out")]) == 2
    assert "pip install 'sw-datasets[pycolmap]'" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
