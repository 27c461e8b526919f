"""Georeferenced scenes: moved to a local origin in double precision, in every layout."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from sw_datasets.loaders.colmap_model import write_model

UTM = (448262.3, 5411932.7, 35.2)
SHIFTS = [UTM, (0.0, 0.0, 6378137.0), (-2.3e6, 0.0, 0.0), (3000.0, -4000.0, 12.0)]


def turned(model, shift):
    """The model of the same cameras and points, those at odd numbers turned about y, all moved by `shift`."""
    shift = np.array(shift)
    for key, image in model.images.items():
        a = 0.1 * key
        R = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
        centre = np.array([0.3 * key, 0.1 * key * key, 0.0]) + shift
        model.images[key] = replace(image, qvec=(np.cos(a / 2), 0.0, np.sin(a / 2), 0.0), tvec=tuple(-R @ centre))
    model.points.xyz[:] = model.points.xyz + shift
    return model


def colmap(folder, shift):
    model = turned(folder.model(), shift)
    root = folder.write()
    write_model(model, root / "sparse" / "0")
    return root


@pytest.mark.parametrize("shift", SHIFTS)
def test_the_same_scene_far_out_is_the_same_scene(colmap_folder, load, shift, tmp_path):
    near = load(colmap(colmap_folder, (0, 0, 0)))
    assert near.origin == (0.0, 0.0, 0.0)
    far = load(colmap(colmap_folder, shift))
    assert any("moved to a local origin at (" in line for line in far.warnings)
    rest = torch.tensor(shift, dtype=torch.float64) - torch.tensor(far.origin, dtype=torch.float64)
    assert rest.norm() < 10
    for a, b in zip(near.train + near.test, far.train + far.test, strict=True):
        assert a.name == b.name
        torch.testing.assert_close(a.camera.R, b.camera.R)
        torch.testing.assert_close(b.camera.center.double() - rest, a.camera.center.double(), atol=1e-5, rtol=0)
    torch.testing.assert_close(far.points.xyz.double() - rest, near.points.xyz.double(), atol=1e-5, rtol=0)
    assert far.extent == pytest.approx(near.extent, rel=1e-5)
    assert far.points.xyz.dtype == torch.float32
    assert far.train[0].camera.tau.dtype == torch.float32


def test_the_origin_does_not_follow_the_split_or_the_resolution(colmap_folder, load):
    root = colmap(colmap_folder, UTM)
    assert len({load(root, **o).origin for o in ({}, {"split": "all"}, {"test_every": 3}, {"resolution": 2})}) == 1


@pytest.mark.parametrize("name", ["transforms.json", "transforms_train.json"])
@pytest.mark.parametrize("cloud", [True, False])
def test_transforms_and_their_clouds_are_moved_too(tmp_path, load, name, cloud):
    (tmp_path / "s" / "images").mkdir(parents=True)
    frames = []
    for i in range(9):
        Image.new("RGB", (32, 24)).save(tmp_path / "s" / "images" / f"{i}.png")
        c, s = np.cos(0.3 * i), np.sin(0.3 * i)
        matrix = [[c, 0, s, UTM[0] + 4 * s], [0, 1, 0, UTM[1]], [-s, 0, c, UTM[2] + 4 * c], [0, 0, 0, 1]]
        frames.append({"file_path": f"images/{i}.png", "transform_matrix": matrix})
    (tmp_path / "s" / name).write_text(json.dumps({"fl_x": 30, "frames": frames}))
    if cloud:
        rows = "".join(f"{UTM[0] + 0.1 * i!r} {UTM[1]!r} {UTM[2]!r}\n" for i in range(5))
        (tmp_path / "s" / "points3d.ply").write_text(
            "ply\nformat ascii 1.0\nelement vertex 5\nproperty double x\nproperty double y\nproperty double z\n"
            f"end_header\n{rows}"
        )
    scene = load(tmp_path / "s", split="all", init_points=200)
    assert any(scene.origin)
    focus = torch.tensor(UTM, dtype=torch.float64) - torch.tensor(scene.origin, dtype=torch.float64)
    distances = [(view.camera.center.double() - focus).norm().item() for view in scene.train]
    assert distances == pytest.approx([4.0] * 9, abs=1e-5)
    if cloud:
        torch.testing.assert_close(
            (scene.points.xyz.double() - focus)[:, 0], torch.arange(5) * 0.1, check_dtype=False, atol=1e-5, rtol=0
        )
    else:
        assert (scene.points.xyz.double() - focus).norm(dim=1).max() < 8


def test_a_scene_of_one_place_far_out_is_moved_and_told(colmap_folder, load):
    model = turned(colmap_folder.model(), UTM)
    root = colmap_folder.write()
    for key, image in model.images.items():
        a = 0.1 * key
        R = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
        model.images[key] = replace(image, tvec=tuple(-R @ np.array(UTM)))
    write_model(model, root / "sparse" / "0")
    scene = load(root)
    assert any(scene.origin)
    assert any("all training cameras stand at one place" in line for line in scene.warnings)


@pytest.mark.parametrize(("scale", "told"), [(1.0, False), (1000.0, False), (0.01, True), (1e-4, True)])
def test_a_scene_too_small_for_the_near_plane_gets_one_of_its_own(colmap_folder, load, scale, told):
    model = colmap_folder.model()
    for key, image in model.images.items():
        model.images[key] = replace(image, tvec=tuple(scale * x for x in image.tvec))
    model.points.xyz[:] *= scale
    root = colmap_folder.write()
    write_model(model, root / "sparse" / "0")
    scene = load(root)
    assert any("the near plane is moved to" in line for line in scene.warnings) == told
    near = scene.train[0].camera.near
    assert near == (pytest.approx(0.02 * 5 * scale) if told else 0.2)
