"""Normals of depth maps against closed forms, edges, and gradients against finite differences."""

import math

import pytest
import torch
from sw_gaussians.knn import nearest_neighbors

from splatwizard_core.scene.camera import Camera
from sw_trimgs.normals import near_surface, normal_difference, normals_of_depth, roughness, smooth_pixels, world_points


def camera(width=40, height=30, dtype=torch.float64):
    eye, target = torch.tensor([0.3, -0.2, -4.0], dtype=dtype), torch.zeros(3, dtype=dtype)
    up = torch.tensor([0.0, 1.0, 0.0], dtype=dtype)
    return Camera.look_at(eye, target, up, width=width, height=height, fov_x=0.8)


def plane_depth(cam, normal, offset):
    """[1,H,W] camera z of the plane normal . X = offset in the world."""
    rays = world_points(torch.ones(1, cam.height, cam.width, dtype=cam.R.dtype), cam) - cam.center[:, None, None]
    distance = offset - float(normal @ cam.center)
    return (distance / torch.einsum("i,ihw->hw", normal, rays))[None]


def tilted(degrees):
    t = math.radians(degrees)
    return torch.tensor([math.sin(t), 0.3 * math.sin(t), -math.cos(t)], dtype=torch.float64) / math.sqrt(
        1 + 0.09 * math.sin(t) ** 2
    )


@pytest.mark.parametrize("reach", [1, 2, 3])
@pytest.mark.parametrize("degrees", [0, 45, 60])
def test_a_plane_has_one_normal_everywhere_inside(degrees, reach):
    cam, normal = camera(), tilted(degrees)
    found = normals_of_depth(plane_depth(cam, normal, 0.0), cam, reach)
    inside = found[:, reach:-reach, reach:-reach]
    assert torch.allclose(inside, normal[:, None, None].expand_as(inside), atol=1e-9)


def test_normals_look_at_the_camera():
    cam = camera()
    depth = 4 + torch.rand(1, cam.height, cam.width, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    found, points = normals_of_depth(depth, cam, 2), world_points(depth, cam)
    assert bool(((cam.center[:, None, None] - points) * found).sum(dim=0).ge(0).all())


def test_without_depth_there_is_no_normal_and_no_gradient_explodes():
    cam = camera(dtype=torch.float32)
    depth = torch.zeros(1, cam.height, cam.width)
    depth[:, :, :5] = 3.0
    depth.requires_grad_()
    found = normals_of_depth(depth, cam, 2)
    assert not found[:, :, 12:].any()
    found.sum().backward()
    assert bool(depth.grad.isfinite().all())


def test_an_edge_and_what_is_near_it_does_not_count():
    depth = torch.full((1, 9, 12), 2.0)
    depth[:, :, 6:] = 3.0  # the derivative is not 0 at columns 5 and 6
    assert smooth_pixels(depth, 0.05, 0)[0, 4].tolist() == [1] * 5 + [0] * 2 + [1] * 5
    assert smooth_pixels(depth, 0.05, 1)[0, 4].tolist() == [1] * 4 + [0] * 4 + [1] * 4
    assert smooth_pixels(depth, 0.0, 1).all()


def test_the_slope_of_an_edge_is_that_of_sobel_over_three():
    ramp = (0.01 * torch.arange(12.0)).expand(1, 9, 12)  # 8 / 3 of 0.01 a pixel
    assert smooth_pixels(ramp, 0.0267, 0)[0, 4, 1:-1].all()
    assert not smooth_pixels(ramp, 0.0266, 0)[0, 4, 1:-1].any()


def test_agreement_is_nothing_and_opposition_is_counted_under_the_mask():
    cam, normal = camera(), tilted(30)
    depth = plane_depth(cam, normal, 0.0)
    drawn = 0.7 * normals_of_depth(depth, cam, 1)  # composited, so of any length
    everywhere = torch.ones_like(depth)
    assert float(normal_difference(drawn, depth, cam, everywhere, 1)) == pytest.approx(0, abs=1e-9)
    half = everywhere.clone()
    half[:, :, : cam.width // 2] = 0
    whole = float(normal_difference(-drawn, depth, cam, everywhere, 1))
    assert whole == pytest.approx(float(normal.abs().mean()), rel=0.05)  # the border differs
    assert 0 < float(normal_difference(-drawn, depth, cam, half, 1)) < 0.6 * whole


def test_the_gradients_are_those_of_finite_differences():
    cam = camera(8, 6)
    g = torch.Generator().manual_seed(1)
    depth = (4 + 0.1 * torch.rand(1, 6, 8, dtype=torch.float64, generator=g)).requires_grad_()
    drawn = torch.randn(3, 6, 8, dtype=torch.float64, generator=g).requires_grad_()
    mask = torch.rand(1, 6, 8, dtype=torch.float64, generator=g)
    assert torch.autograd.gradcheck(lambda n, z: normal_difference(n, z, cam, mask, 2), (drawn, depth), atol=1e-6)


def test_equal_normals_are_smooth_whichever_way_they_look():
    neighbors = torch.tensor([[0, 1, 2]] * 3)
    up = torch.tensor([[0.0, 0, 1], [0, 0, -1], [0, 0, 1]])
    every = torch.ones(3, dtype=torch.bool)
    assert float(roughness(up, neighbors, every)) == pytest.approx(0, abs=1e-7)
    bent = torch.tensor([[0.0, 0, 1], [0, 0, 1], [0, 1, 0]])
    mean = torch.tensor([0.0, 1, 2]) / math.sqrt(5)
    expected = (bent - mean).abs().mean() / 2
    assert float(roughness(bent, neighbors, every)) == pytest.approx(float(expected))
    assert float(roughness(bent, neighbors, torch.zeros(3, dtype=torch.bool))) == 0


def test_only_what_is_near_the_depth_map_is_chosen():
    cam = camera(dtype=torch.float32)
    depth = torch.full((1, cam.height, cam.width), 4.0)
    places = torch.tensor([[0.0, 0, 4.9], [0, 0, 5.1], [0, 0, 3.1], [9, 0, 4.0], [0, 0, -4.0]])
    means = (places - cam.tau) @ cam.R
    assert near_surface(means, depth, cam, 1.0).tolist() == [True, False, True, False, False]


def test_neighbours_are_the_nearest_points_the_point_itself_first():
    points = torch.rand(30, 3, generator=torch.Generator().manual_seed(2))
    found = nearest_neighbors(points, 4)
    assert found.dtype == torch.int32
    assert torch.equal(found.long(), torch.cdist(points, points).topk(4, largest=False).indices)
    assert found[:, 0].tolist() == list(range(30))
    assert nearest_neighbors(points[:2], 4).shape == (2, 2)
    assert nearest_neighbors(points[:0], 4).shape == (0, 0)
    assert nearest_neighbors(points[:1], 1).tolist() == [[0]]
