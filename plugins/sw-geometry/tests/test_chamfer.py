"""The analytic protocol: distances against exact shapes, what the cameras see, and the scores."""

import numpy as np
import pytest
import torch
from small_meshes import sphere
from sw_geometry.chamfer import Truth, compare, compare_points, seen_by
from sw_geometry.mesh import Floats, Mesh

from splatwizard_core.api import Camera, Protocol, Scene, View


def unit_points(count: int, seed: int = 0) -> Floats:
    found = np.random.default_rng(seed).normal(size=(count, 3))
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def ball(points: Floats) -> Floats:
    return np.linalg.norm(points, axis=1) - 1


def test_a_larger_sphere_is_as_far_as_its_radius_says():
    points = unit_points(3000)
    found = compare(sphere(60, r=1.1), Truth(points, points, ball), tau=0.05, samples=5000)
    assert found["acc"] == pytest.approx(0.1, abs=0.002)  # facets lie up to r (pi / 120)^2 / 2 inside
    assert found["comp"] == pytest.approx(0.1, abs=0.002)
    assert found["overall"] == (found["acc"] + found["comp"]) / 2
    assert found["precision"] == found["recall"] == found["f1"] == 0
    assert found["normal_consistency"] > 0.99


def test_half_a_sphere_is_exact_and_not_complete():
    whole, points = sphere(40), unit_points(3000)
    upper = whole.with_vertices(whole.vertices[:, 2] > -1e-9)
    found = compare(upper, Truth(points, None, ball), tau=0.02, samples=5000)
    assert found["acc"] < 0.003
    assert found["precision"] == 1
    assert found["recall"] == pytest.approx(0.5, abs=0.04)
    assert found["f1"] == pytest.approx(2 * found["recall"] / (1 + found["recall"]))
    assert "normal_consistency" not in found


def test_sampled_truth_has_no_floor_with_its_normals():
    """Points alone are far apart: 1 / (2 sqrt n) of the area each, a floor under every distance."""
    points, mesh = unit_points(500), sphere(60)
    bare = compare(mesh, Truth(points), tau=0.02, samples=5000)
    normals = compare(mesh, Truth(points, points), tau=0.02, samples=5000)
    assert bare["acc"] == pytest.approx(1 / (2 * np.sqrt(500 / (4 * np.pi))), rel=0.1)
    assert normals["acc"] < 0.1 * bare["acc"]


def test_points_are_compared_point_to_point():
    points = unit_points(500)
    found = compare_points(1.1 * points, Truth(points, None, ball), tau=0.15)
    assert found["acc"] == pytest.approx(0.1)
    assert found["comp"] == pytest.approx(0.1)
    assert found["f1"] == 1
    with pytest.raises(ValueError, match="no point"):
        compare_points(points[:0], Truth(points), tau=0.1)


def test_a_mesh_without_area_is_refused():
    flat = Mesh(np.zeros((3, 3)), np.array([[0, 1, 2]]))
    with pytest.raises(ValueError, match="without area"):
        compare(flat, Truth(unit_points(5)), tau=0.1)


def test_scaling_everything_scales_the_distances():
    points, mesh = unit_points(800), sphere(20, r=1.05)
    one = compare(mesh, Truth(points, points), tau=0.05, samples=3000)
    ten = compare(mesh.moved(10, np.ones(3)), Truth(10 * points + 1, points), tau=0.5, samples=3000)
    assert ten["overall"] == pytest.approx(10 * one["overall"], rel=1e-9)
    assert ten["f1"] == pytest.approx(one["f1"])


def cameras(*eyes: tuple[float, float, float]) -> list[Camera]:
    up = torch.tensor([0.0, 0, 1])
    return [Camera.look_at(torch.tensor(e), torch.zeros(3), up, width=64, height=48, fov_x=0.9) for e in eyes]


def depth_of_sphere(camera: Camera) -> torch.Tensor:
    """[1,H,W]: exact z of the unit sphere about the origin; 0 beside it."""
    x = (torch.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (torch.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    d = torch.stack([x.expand(camera.height, -1), y[:, None].expand(-1, camera.width), torch.ones(48, 64)], dim=2)
    o = camera.tau  # the centre of the sphere in the camera
    a, b, c = (d * d).sum(2), (d * o).sum(2), (o * o).sum() - 1
    root = b * b - a * c
    return torch.where(root > 0, (b - root.clamp(min=0).sqrt()) / a, 0)[None]


def test_a_camera_sees_its_side_of_a_sphere():
    points = unit_points(2000)
    (camera,) = cameras((4.0, 0, 0))
    seen = seen_by(points, [(camera, depth_of_sphere(camera))]) > 0
    assert seen[points[:, 0] > 0.5].all()  # the horizon is at x = 1 / 4
    assert not seen[points[:, 0] < 0.15].any()


def test_points_that_fewer_than_two_cameras_see_are_no_truth():
    eyes = cameras((4.0, 0, 0), (0.0, 4, 0))
    views = [View(camera, f"{i}.png") for i, camera in enumerate(eyes)]
    points = torch.from_numpy(unit_points(2000))
    scene = Scene("ball", views, [], None, Protocol("toy"))
    assert Truth.of(scene) is None
    scene.ground_truth["points"] = points
    assert len(Truth.of(scene).points) == 2000
    scene.ground_truth |= {"normals": points, "depth": {v.name: depth_of_sphere(v.camera) for v in views}}
    truth = Truth.of(scene)
    assert (truth.points[:, :2] > 0.1).all()
    assert np.array_equal(truth.points, truth.normals)
    assert len(truth.points) > 200
