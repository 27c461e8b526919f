"""The checks that every family of scenes shares, and the camera they check."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from sw_datasets.assemble import assemble_scene

from splatwizard_core.errors import SceneError, ShapeError
from splatwizard_core.scene.camera import Camera
from splatwizard_core.scene.scene import PointCloud, Protocol, View

CAMERA = Camera(32, 24, 30.0, 31.0, 16.0, 12.0, torch.eye(3), torch.zeros(3))


def views(*names):
    return [View(replace(CAMERA, tau=torch.tensor([float(i), 0, 0])), name) for i, name in enumerate(names)]


def assemble(found, points=None, split="every2", **more):
    return assemble_scene("made", found, points=points, protocol=Protocol("made", split=split), **more)


def test_views_are_sorted_by_the_name_as_text():
    scene = assemble(views("r_10", "r_9", "R_1", "r_2"))
    assert [v.name for v in scene.test + scene.train] == ["R_1", "r_2", "r_10", "r_9"]


def test_no_view_equal_names_and_a_split_nobody_brings_are_refused():
    with pytest.raises(SceneError, match="made: no views; a scene needs at least 2"):
        assemble([])
    with pytest.raises(SceneError, match="made: image name 'a' occurs more than once"):
        assemble(views("a", "b", "a"))
    with pytest.raises(SceneError, match="made: split 'file', but the scene brings no split"):
        assemble(views("a", "b"), split="file")


@pytest.mark.parametrize("bad", [{"tau": torch.tensor([0, math.inf, 0])}, {"R": torch.full((3, 3), math.nan)}])
def test_a_pose_that_is_not_finite_names_its_image(bad):
    found = views("a", "b")
    found[1].camera = replace(CAMERA, **bad)
    with pytest.raises(SceneError, match="made: the pose of image 'b' is not finite"):
        assemble(found)


@pytest.mark.parametrize("bad", [{"fx": -1.0}, {"fy": math.nan}, {"cx": math.inf}, {"fx": 1e300}, {"fy": 1e-300}])
def test_intrinsics_that_make_no_sense_name_their_image(bad):
    found = views("a", "b")
    found[0].camera = replace(CAMERA, **bad)
    with pytest.raises(SceneError, match="the intrinsics of image 'a' make no sense"):
        assemble(found)


def test_points_without_colour_are_fine_and_points_none_of_which_is_finite_are_not():
    cloud = PointCloud(torch.tensor([[0.0, 1, 2], [math.nan, 0, 0]]))
    scene = assemble(views("a", "b"), cloud)
    assert scene.points.xyz.tolist() == [[0, 1, 2]]
    assert scene.points.rgb is None
    with pytest.raises(SceneError, match="none of the 2 points is finite"):
        assemble(views("a", "b"), PointCloud(torch.full((2, 3), math.inf)))


def test_cameras_at_one_place_get_extent_1_with_a_warning():
    found = [View(CAMERA, name) for name in "abcd"]
    scene = assemble(found)
    assert scene.extent == 1.0
    assert "all training cameras stand at one place: the scene extent is set to 1.0" in scene.warnings[0]


def test_cameras_that_turn_at_one_place_differ_by_rounding_alone():
    eye, up = torch.tensor([1.3, -2.1, 0.7]), torch.tensor([0.0, 0, 1])
    around = [eye + torch.tensor([math.sin(i), math.cos(i), 0.2]) for i in range(8)]
    found = [Camera.look_at(eye, target, up, width=40, height=30, fov_x=1.0) for target in around]
    assert len({tuple(camera.center.tolist()) for camera in found}) > 1
    scene = assemble([View(camera, f"{i}") for i, camera in enumerate(found)])
    assert (scene.radius, scene.extent) == (0.0, 1.0)
    assert "all training cameras stand at one place" in scene.warnings[0]
    found[3] = replace(found[3], tau=found[3].tau + 1e-3)
    assert assemble([View(camera, f"{i}") for i, camera in enumerate(found)]).extent < 1e-2


def test_cameras_far_from_the_origin_keep_their_extent_and_are_moved():
    center, up = torch.tensor([2e5, 5e6, 0.0], dtype=torch.float64), torch.tensor([0.0, 0, 1])  # UTM: easting, northing
    found = []
    for angle in (i * math.pi / 4 for i in range(8)):
        eye = torch.tensor([40 * math.cos(angle), 40 * math.sin(angle), 30.0])
        camera = Camera.look_at(eye, torch.zeros(3), up, width=40, height=30, fov_x=1.0)
        tau = (-camera.R.double() @ (eye.double() + center)).float()
        found.append(View(replace(camera, tau=tau), f"{angle}"))
    scene = assemble(found, split="all")
    assert scene.extent == pytest.approx(44, abs=1)  # float32 numbers of this size are 0.5 apart
    assert scene.origin[:2] == pytest.approx((2e5, 5e6), abs=1)
    assert ["moved to a local origin at (" in line for line in scene.warnings] == [True]


def test_a_view_without_picture_says_so():
    with pytest.raises(ValueError, match="view 'a' has no picture"):
        _ = views("a")[0].pixels


def test_look_at_puts_the_target_in_the_middle_and_up_upwards():
    eye, target, up = torch.tensor([[3.0, 1, 2], [0.5, 0, 0], [0, 0, 1]])
    camera = Camera.look_at(eye, target, up, width=40, height=30, fov_x=1.0)
    torch.testing.assert_close(camera.center, eye)
    for point, u, v in ((target, 20, 15), (target + 0.1 * up, 20, None)):
        x = camera.R @ point + camera.tau
        assert camera.fx * x[0] / x[2] + camera.cx == pytest.approx(u, abs=1e-3)
        row = camera.fy * x[1] / x[2] + camera.cy
        assert row == pytest.approx(v, abs=1e-3) if v is not None else row < 15
    assert camera.fov_x == pytest.approx(1.0)


def test_a_resized_camera_keeps_its_field_of_view():
    small = CAMERA.resized(16, 8)
    assert (small.fov_x, small.fov_y) == pytest.approx((CAMERA.fov_x, CAMERA.fov_y), rel=1e-12)
    assert (small.fx, small.fy, small.cx, small.cy) == pytest.approx((15.0, 31 / 3, 8.0, 4.0))
    torch.testing.assert_close(small.K, torch.tensor([[15.0, 0, 8], [0, 31 / 3, 4], [0, 0, 1]]))
    assert CAMERA.to(torch.device("cpu")) is CAMERA
    assert CAMERA.to(dtype=torch.float64).viewmat.dtype == torch.float64


def test_a_camera_of_the_wrong_shape_is_refused():
    with pytest.raises(ShapeError, match=r"R \[3,3\] and tau \[3\]"):
        Camera(4, 4, 1.0, 1.0, 2.0, 2.0, torch.eye(4), torch.zeros(3))


def test_a_camera_is_moved_once_and_keeps_its_pose():
    moved = CAMERA.to(dtype=torch.float64)
    assert moved is CAMERA.to(dtype=torch.float64)
    assert moved.R.dtype == torch.float64
    assert CAMERA.to("cpu") is CAMERA
    assert replace(CAMERA, width=64).to(dtype=torch.float64) is not moved


def test_a_camera_that_is_trained_is_moved_anew_each_time():
    tau = torch.zeros(3, requires_grad=True)
    camera = replace(CAMERA, tau=tau)
    for _ in range(2):
        camera.to(dtype=torch.float64).tau.sum().backward()
    assert tau.grad is not None
    assert tau.grad.tolist() == [2.0, 2.0, 2.0]
