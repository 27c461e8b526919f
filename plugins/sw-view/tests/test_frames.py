"""Cameras of browsers, the pace of pictures while they move, and two pictures in one."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from sw_view.frames import (
    BUDGET,
    LARGEST_SIDE,
    LEAST_SHARE,
    REST,
    Pace,
    camera_at,
    frame_size,
    orientation_of,
    side_by_side,
)
from sw_view.shown_cameras import looked_at, surroundings_about, surroundings_of

from splatwizard_core.api import Camera, Protocol, Scene, SceneError, SceneOptions, View
from splatwizard_core.tooling import load_plugins, load_scene

HALF_TURNS = [  # trace -1: the branches of the largest component
    torch.tensor([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]]), torch.tensor([[-1.0, 0, 0], [0, 1, 0], [0, 0, -1]]),
    torch.tensor([[-1.0, 0, 0], [0, -1, 0], [0, 0, 1]]),
]  # fmt: skip


def rotations() -> list[torch.Tensor]:
    draw = torch.Generator().manual_seed(0)
    random = [torch.linalg.qr(torch.randn(3, 3, generator=draw, dtype=torch.float64)).Q for _ in range(20)]
    return [*(q * torch.linalg.det(q).sign() for q in random), *(turn.double() for turn in HALF_TURNS)]


@pytest.mark.parametrize("rotation", rotations())
def test_a_camera_comes_back_from_its_orientation(rotation):
    before = Camera(64, 48, 50.0, 50.0, 32.0, 24.0, rotation, torch.tensor([0.3, -2.0, 5.0], dtype=torch.float64))
    position = (-rotation.T @ before.tau).numpy()
    after = camera_at(orientation_of(before), position, 2 * math.atan(24 / 50), (64, 48))
    torch.testing.assert_close(after.R.double(), rotation, atol=1e-6, rtol=0)
    torch.testing.assert_close(after.tau.double(), before.tau, atol=1e-5, rtol=0)
    assert (after.fx, after.fy, after.cx, after.cy) == pytest.approx((50, 50, 32, 24))


def test_quaternions_of_any_length_are_orientations():
    one, two = (camera_at(np.array([1.0, 2, 3, 4]) * s, [0, 0, 0], 1.0, (64, 64)) for s in (1, 7))
    torch.testing.assert_close(one.R, two.R)
    torch.testing.assert_close(one.R @ one.R.T, torch.eye(3), atol=1e-6, rtol=0)


def converged(seconds_of, rounds: int = 60) -> Pace:
    pace = Pace()
    for _ in range(rounds):
        pace.drew(pace.share, seconds_of(pace.share))
    return pace


def test_a_frame_that_moves_takes_the_budget():
    pace = converged(lambda share: 0.4 * share**2)
    assert 0.4 * pace.share**2 == pytest.approx(BUDGET, rel=0.05)
    assert pace.of(0.0) == pace.share
    assert pace.of(REST) == 1.0


def test_what_is_fast_is_drawn_in_full_and_what_is_slow_no_smaller_than_the_least():
    assert converged(lambda share: 0.01 * share**2).share == 1.0
    assert converged(lambda share: 100 * share**2).share == LEAST_SHARE


def test_time_that_pixels_do_not_save_costs_no_pixels():
    assert converged(lambda share: 0.8 + 0.1 * share**2).share == 1.0


def test_frames_have_even_sides_and_no_more_pixels_than_a_large_screen():
    assert frame_size(1281, 721, 0.5) == (640, 360)
    assert frame_size(3840, 2160, 1.0) == (LARGEST_SIDE, 1080)
    assert frame_size(10, 10, 0.1) == (16, 16)


def test_two_pictures_side_by_side():
    black, grey = np.zeros((4, 10, 3), np.uint8), np.full((4, 10, 3), 100, np.uint8)
    both = side_by_side(black, grey, 0.5)
    assert both[0, :, 0].tolist() == [0, 0, 0, 0, 255, 255, 100, 100, 100, 100]
    assert (side_by_side(black, grey, 1.0) == 0).all()
    assert (side_by_side(black, grey, 0.0) == 100).all()


def test_the_pivot_is_where_the_cameras_look():
    target = torch.tensor([1.0, 2.0, 3.0])
    eyes = [torch.tensor(e) for e in ([5.0, 0, 0], [0, 6.0, 1], [-3.0, 2, 8])]
    up = torch.tensor([0.0, 0.0, 1.0])
    cameras = [Camera.look_at(eye, target, up, width=8, height=8, fov_x=1.0) for eye in eyes]
    centers, forwards = (np.stack([v.double().numpy() for v in values]) for values in
                         ([c.center for c in cameras], [c.R[2] for c in cameras]))  # fmt: skip
    np.testing.assert_allclose(looked_at(centers, forwards, 1.0), target, atol=1e-5)
    parallel = looked_at(centers, np.tile([0.0, 0, 1], (3, 1)), 4.0)
    np.testing.assert_allclose(parallel, centers.mean(axis=0) + np.array([0, 0, 4]))


@pytest.mark.parametrize("turns", [3, 8])
def test_cameras_that_turn_at_one_place_look_at_what_is_ahead_of_them(turns):
    eye, up = torch.tensor([1.3, -2.1, 0.7]), torch.tensor([0.0, 0, 1])
    angles = [2 * math.pi * i / 8 for i in range(turns)]
    targets = [eye + torch.tensor([math.sin(a), math.cos(a), 0.2]) for a in angles]
    cameras = [Camera.look_at(eye, target, up, width=8, height=8, fov_x=1.0) for target in targets]
    views = [View(camera, str(i)) for i, camera in enumerate(cameras)]
    around = surroundings_of(Scene("turning", views, [], None, Protocol("toy")))
    assert around.size == pytest.approx(1, abs=1e-5)
    assert np.linalg.norm(around.pivot - eye.numpy()) == pytest.approx(1, abs=1e-5)


def test_a_model_of_nothing_that_can_be_drawn_is_refused():
    with pytest.raises(SceneError, match="no Gaussian that can be drawn"):
        surroundings_about(np.zeros((0, 3), np.float32))


def test_the_demo_is_seen_from_its_test_cameras_first_with_its_up():
    scene = load_scene("demo:tiny", SceneOptions(), load_plugins())
    around = surroundings_of(scene)
    assert [each.name for each in around.cameras[:2]] == [f"{view.name} (test)" for view in scene.test]
    assert len(around.cameras) == len(scene.train) + len(scene.test)
    assert np.linalg.norm(around.up) == pytest.approx(1)
    assert all(float(-view.camera.R[1].double().numpy() @ around.up) > 0 for view in scene.train)


def test_far_points_do_not_move_made_up_cameras_away():
    draw = np.random.default_rng(0)
    points = draw.normal(size=(1000, 3)).astype(np.float32)
    points[:20] += 1e4
    around = surroundings_about(points)
    assert np.abs(around.pivot).max() < 0.2
    assert around.size < 12
