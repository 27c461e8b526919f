"""Camera paths: where they pass, where they look, and that they are smooth."""

from __future__ import annotations

import math

import pytest
import torch
from sw_view.camera_paths import along, focus_of, orbit, spiral

from splatwizard_core.api import Camera, SceneError

UP = torch.tensor([0.0, 0.0, 1.0])
SIZE = (64, 48)
TARGET = torch.tensor([1.0, -2.0, 0.5])


def looking(eye: torch.Tensor, target: torch.Tensor = TARGET, up: torch.Tensor = UP) -> Camera:
    return Camera.look_at(eye, target, up, width=80, height=60, fov_x=1.0)


@pytest.fixture(scope="module")
def ring() -> list[Camera]:
    """Twelve cameras around TARGET, 3 away and 1 above it."""
    angles = [2 * math.pi * i / 12 for i in range(12)]
    return [looking(TARGET + torch.tensor([3 * math.cos(a), 3 * math.sin(a), 1.0])) for a in angles]


@pytest.fixture(scope="module")
def row() -> list[Camera]:
    """Nine forward-facing cameras on a grid, all looking along +y."""
    eyes = [torch.tensor([x, 0.0, z]) for z in (-0.2, 0.0, 0.2) for x in (-0.5, 0.0, 0.5)]
    return [looking(eye, eye + torch.tensor([0.0, 1.0, 0.0])) for eye in eyes]


def ahead(camera: Camera, point: torch.Tensor) -> torch.Tensor:
    """Where a point is drawn, relative to the centre of the picture, in pixels."""
    x, y, z = camera.R @ point + camera.tau
    assert z > 0
    return torch.stack([camera.fx * x / z, camera.fy * y / z])


def test_an_orbit_keeps_distance_and_height_and_looks_at_the_middle(ring: list[Camera]):
    path = orbit(ring, 16, SIZE, (1.0, 5.0))
    assert len(path) == 16
    for camera in path:
        offset = camera.center - TARGET
        assert offset[2].item() == pytest.approx(1.0, abs=1e-4)
        assert offset[:2].norm().item() == pytest.approx(3.0, abs=1e-4)
        assert ahead(camera, TARGET).abs().max() < 0.01
        assert torch.det(camera.R) == pytest.approx(1.0, abs=1e-5)
        assert camera.R[1, 2] < 0  # the picture's down is the world's
    assert (path[0].center - ring[0].center).norm() < 1e-4
    steps = torch.stack([(a.center - b.center) for a, b in zip(path, [*path[1:], path[0]], strict=True)]).norm(dim=1)
    assert steps.max() - steps.min() < 1e-4  # closed, at an even pace


def test_a_path_has_the_size_asked_for_and_the_field_of_view_of_the_cameras(ring: list[Camera]):
    for path in (orbit(ring, 2, SIZE, (1, 2)), spiral(ring, 2, SIZE, (1, 2)), along(ring, 2, SIZE)):
        for camera in path:
            assert (camera.width, camera.height) == SIZE
            assert camera.fov_y == pytest.approx(ring[0].fov_y)
            assert camera.fx == camera.fy


def test_cameras_that_look_apart_have_no_orbit(ring: list[Camera]):
    outward = [looking(c.center, 2 * c.center - TARGET) for c in ring]
    with pytest.raises(SceneError, match="look away from each other"):
        orbit(outward, 4, SIZE, (1, 2))
    down = [looking(TARGET + torch.tensor([0.0, 0.0, 3.0]), up=torch.tensor([0.0, 1.0, 0.0]))] * 2
    assert len(orbit(down, 4, SIZE, (1, 2))) == 4  # one direction: around its own up
    turned = [Camera.look_at(TARGET + UP * 3, TARGET, torch.tensor([math.cos(a), math.sin(a), 0]), width=8, height=8,
                             fov_x=1.0) for a in (0.0, math.pi)]  # fmt: skip
    with pytest.raises(SceneError, match="no common axis"):
        orbit(turned, 4, SIZE, (1, 2))


def test_parallel_cameras_look_at_the_depth_of_the_scene(row: list[Camera]):
    assert focus_of(row, 4.0) == pytest.approx([0, 4, 0], abs=1e-6)


def test_a_spiral_stays_within_the_cameras_and_looks_at_one_point(row: list[Camera]):
    path = spiral(row, 40, SIZE, (2.0, 6.0))
    target = torch.tensor([0.0, 1 / (0.25 / 2 + 0.75 / 6), 0.0])
    eyes = torch.stack([camera.center for camera in path])
    assert eyes.abs().amax(dim=0).tolist() == pytest.approx([0.5, 0.0, 0.2], abs=0.01)
    assert max(ahead(camera, target).abs().max() for camera in path) < 0.01
    assert (eyes[0] - eyes[-1]).norm() < 0.2  # it closes
    single = torch.stack([camera.center for camera in spiral(row[:1], 8, SIZE, (2.0, 6.0))])
    assert single.std(dim=0).max() > 0.05


def test_a_flight_begins_and_ends_at_cameras_and_passes_the_others(ring: list[Camera]):
    path = along(ring, 221, SIZE)  # 20 steps between two of the cameras
    for i, camera in enumerate(ring):
        assert (path[20 * i].center - camera.center).norm() < 1e-4
        assert (path[20 * i].R - camera.R).abs().max() < 1e-4
    eyes = torch.stack([camera.center for camera in path])
    steps = eyes.diff(dim=0)
    assert steps.norm(dim=1).max() < 1.3 * steps.norm(dim=1).mean()
    # No corner: the direction turns by a small part of the 30 degrees between neighbours.
    turns = torch.nn.functional.cosine_similarity(steps[1:], steps[:-1])
    assert turns.min() > math.cos(math.radians(5))
    assert all(torch.det(camera.R) == pytest.approx(1.0, abs=1e-4) for camera in path)


def test_many_cameras_are_thinned_and_shuffled_ones_are_ordered(ring: list[Camera]):
    few = along(ring, 9, SIZE)
    assert (few[0].center - ring[0].center).norm() < 1e-4
    assert (few[-1].center - ring[-1].center).norm() < 1e-4
    shuffled = [ring[i] for i in (0, 6, 1, 7, 2, 8, 3, 9, 4, 10, 5, 11)]
    steps = torch.stack([camera.center for camera in along(shuffled, 100, SIZE)]).diff(dim=0).norm(dim=1)
    assert steps.sum() < 2.2 * math.pi * 3  # once around, not to and fro
    one = along(ring[:1], 5, SIZE)
    assert all(torch.equal(camera.R, one[0].R) for camera in one)
