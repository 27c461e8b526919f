"""Real photographs, where the development data is there: counts, sizes, and points that project into the pictures."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from sw_datasets.loaders.colmap_model import read_model


@pytest.mark.parametrize(
    ("name", "images", "train", "test", "size", "points"),
    [
        ("fox", "images_2", 43, 7, (270, 480), 12_919),
        ("fox", None, 43, 7, (540, 960), 12_919),
        ("mug", None, 67, 10, (400, 300), 9_262),
    ],
)
def test_colmap_photographs(test_data, load, name, images, train, test, size, points):
    scene = load(test_data(name), images=images)
    assert (len(scene.train), len(scene.test), len(scene.points)) == (train, test, points)
    assert {(v.camera.width, v.camera.height) for v in scene.train + scene.test} == {size}
    assert scene.train[0].pixels.shape == (3, size[1], size[0])
    assert scene.extent > 1
    assert scene.warnings == []


@pytest.mark.parametrize(("name", "images", "limit"), [("fox", "images_2", 0.25), ("mug", None, 0.35)])
def test_observed_points_project_onto_their_keypoints(test_data, load, name, images, limit):
    """limit: px; the data's own mean reprojection error is 0.37 px at 540 px (fox), 0.31 px (mug)."""
    folder = test_data(name)
    model = read_model(folder / "sparse" / "0")
    scene = load(folder, images=images)
    xyz = dict(zip(model.points.ids.tolist(), model.points.xyz, strict=True))
    by_name = {image.name: image for image in model.images.values()}
    errors = []
    for view in scene.train + scene.test:
        image, c = by_name[view.name], view.camera
        full = model.cameras[image.camera_id]
        x = torch.from_numpy(np.stack([xyz[i] for i in image.point_ids.tolist()])).float() @ c.R.T + c.tau
        assert (x[:, 2] > 0).all()
        u, v = c.fx * x[:, 0] / x[:, 2] + c.cx, c.fy * x[:, 1] / x[:, 2] + c.cy
        keypoints = torch.from_numpy(image.xys * [c.width / full.width, c.height / full.height])
        errors.append(torch.hypot(u - keypoints[:, 0], v - keypoints[:, 1]))
        inside = (u >= 0) & (u < c.width) & (v >= 0) & (v < c.height)
        assert inside.float().mean() > 0.99
    assert torch.cat(errors).mean() < limit


def test_colours_of_the_points_are_those_of_the_pictures(test_data, load):
    scene = load(test_data("mug"))
    view = scene.train[0]
    x = scene.points.xyz @ view.camera.R.T + view.camera.tau
    c = view.camera
    u, v = (c.fx * x[:, 0] / x[:, 2] + c.cx).long(), (c.fy * x[:, 1] / x[:, 2] + c.cy).long()
    shown = (x[:, 2] > 0) & (u >= 0) & (u < c.width) & (v >= 0) & (v < c.height)
    picture = view.image()[:, v[shown], u[shown]].T
    right = (picture - scene.points.rgb[shown]).abs().mean()
    shuffled = scene.points.rgb[shown][torch.randperm(int(shown.sum()), generator=torch.Generator().manual_seed(0))]
    assert right < 0.6 * (picture - shuffled).abs().mean()


def test_lego(test_data, load):
    scene = load(test_data("lego"))
    assert (len(scene.train), len(scene.test), len(scene.points)) == (60, 20, 100_000)
    view = scene.train[0]
    assert view.pixels.shape == (4, 200, 200)
    assert view.camera.fov_x == pytest.approx(0.6911112070083618)
    assert view.image(scene.background)[:, 0, 0].tolist() == [1, 1, 1]
    assert view.mask.float().mean() == pytest.approx(0.25, abs=0.15)
    assert scene.extent == pytest.approx(4.03 * 1.1, rel=0.25)  # cameras on a dome of that radius
