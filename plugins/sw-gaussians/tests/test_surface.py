"""Depth and normals of the surface, held against planes and spheres whose exact depth is known."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from sw_gaussians.surface import depth_normals, surface_depth, world_normals
from torch import Tensor

from splatwizard_core.api import Camera, ConfigError

WIDTH, HEIGHT, FOCAL = 256, 192, 301.5


def camera_at(eye: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Camera:
    """A camera that looks away from the axes, so that the frames of camera and world differ."""
    start = torch.tensor(eye)
    made = Camera.look_at(
        start, start + torch.tensor([0.3, -0.2, 1.0]), torch.tensor([0.1, -1.0, 0.0]),
        width=WIDTH, height=HEIGHT, fov_x=2 * math.atan(WIDTH / (2 * FOCAL)),
    )  # fmt: skip
    assert made.fx == pytest.approx(FOCAL)
    return made


def rays(camera: Camera) -> Tensor:
    """[3,H,W] float64 directions through pixel centres, camera frame, z = 1."""
    x = (torch.arange(camera.width, dtype=torch.float64) + 0.5 - camera.cx) / camera.fx
    y = (torch.arange(camera.height, dtype=torch.float64) + 0.5 - camera.cy) / camera.fy
    return torch.stack(
        [x.expand(camera.height, -1), y[:, None].expand(-1, camera.width), torch.ones(192, 256).double()]
    )


def inside(normals: Tensor) -> Tensor:
    return normals[:, 1:-1, 1:-1]


def angles(found: Tensor, exact: Tensor) -> Tensor:
    """Degrees between unit vectors [3,...], exact for small ones too."""
    found, exact = found.double(), exact.double()
    return torch.rad2deg(torch.atan2(torch.linalg.cross(found, exact, dim=0).norm(dim=0), (found * exact).sum(dim=0)))


def plane_depth(camera: Camera, tilt: float) -> tuple[Tensor, Tensor]:
    """(depth [1,H,W] float32, world normal [3]) of a plane through (0, 0, 4) of the camera frame; tilt in degrees."""
    t = math.radians(tilt)
    normal = torch.tensor([math.sin(t) * 0.6, math.sin(t) * 0.8, -math.cos(t)], dtype=torch.float64)
    z = normal[2] * 4 / (rays(camera) * normal[:, None, None]).sum(dim=0)
    return z[None].float(), camera.R.double().T @ normal


def facing(normals: Tensor, camera: Camera) -> bool:
    """Whether all interior normals point against the line of sight."""
    towards = world_normals(rays(camera).float(), camera)
    return bool(((normals * towards).sum(dim=0)[1:-1, 1:-1] < 0).all())


@pytest.mark.parametrize("tilt", [0, 45, 75])
def test_normals_of_a_plane_are_those_of_the_plane(tilt: float) -> None:
    camera = camera_at((1.0, -2.0, 0.5))
    depth, exact = plane_depth(camera, tilt)
    shown = inside(depth)  # at 75 degrees a part of the plane lies behind the camera
    clear = (torch.nn.functional.max_pool2d(-depth, 3, 1) < -0.5)[0] & (shown[0] < 50)
    assert clear.float().mean() > 0.6
    found = inside(depth_normals(depth, camera))
    error = angles(found, exact[:, None, None].expand_as(found))
    # Float32 depth, measured 0.0007 degrees; farther along the tilt its digits run out.
    near = clear & (shown[0] < 8)
    assert error[near].max() < 1e-3
    # Rays through pixel corners instead of centres would be off by 0.048 degrees at 45 degrees of tilt.
    corners = dataclasses.replace(camera, cx=camera.cx + 0.5, cy=camera.cy + 0.5)
    if tilt == 45:
        wrong = angles(inside(depth_normals(depth, corners)), exact[:, None, None].expand_as(found))
        assert wrong[near].mean() > 0.02


def test_normals_of_a_sphere_are_as_exact_as_its_curvature_allows() -> None:
    camera = camera_at((0.5, 0.0, -1.0))
    directions = rays(camera)
    center = torch.tensor([0.0, 0.0, 4.0], dtype=torch.float64)
    along, square = (directions * center[:, None, None]).sum(dim=0), (directions**2).sum(dim=0)
    root = along**2 - square * (center @ center - 1)
    hit = root > 0
    z = torch.where(hit, (along - root.clamp(min=0).sqrt()) / square, 0)
    normal = directions * z - center[:, None, None]  # unit: the radius is 1
    incidence = torch.rad2deg(torch.acos((-(normal * directions).sum(dim=0) / square.sqrt()).clamp(-1, 1)))
    found = depth_normals(z[None].float(), camera)
    error = angles(found, world_normals(normal, dataclasses.replace(camera, R=camera.R.double())))
    clear = -torch.nn.functional.max_pool2d(-hit[None].double(), 3, 1, 1)[0] > 0
    for low, high, bound in ((0, 30, 0.004), (30, 60, 0.018), (60, 75, 0.14), (75, 85, 1.6)):
        band = clear & (incidence >= low) & (incidence < high)
        assert band.sum() > 500
        assert error[band].mean() < bound, f"{low}-{high} degrees"
    visible = (found.norm(dim=0) > 0) & clear
    assert bool(((found * world_normals(directions.float(), camera)).sum(dim=0)[visible] < 0).all())


def test_normals_face_the_camera_and_the_border_is_zero() -> None:
    camera = camera_at()
    depth, _ = plane_depth(camera, 30)
    normals = depth_normals(depth, camera)
    assert normals.shape == (3, HEIGHT, WIDTH)
    assert facing(normals, camera)
    border = normals.clone()
    border[:, 1:-1, 1:-1] = 0
    assert torch.equal(border, torch.zeros_like(border))
    assert torch.allclose(inside(normals).norm(dim=0), torch.ones(HEIGHT - 2, WIDTH - 2), atol=1e-6)


def test_normals_are_differentiable_in_the_depth() -> None:
    camera = camera_at().resized(7, 6).to(dtype=torch.float64)
    generator = torch.Generator().manual_seed(3)
    depth = 3 + torch.rand(1, 6, 7, generator=generator, dtype=torch.float64)
    weights = torch.rand(3, 6, 7, generator=generator, dtype=torch.float64)
    depth.requires_grad_()
    assert torch.autograd.gradcheck(lambda z: (weights * depth_normals(z, camera)).sum(), depth, atol=1e-6)


def test_pixels_without_surface_have_no_normal_and_a_gradient_of_zero() -> None:
    camera = camera_at()
    depth = torch.zeros(1, HEIGHT, WIDTH)
    depth[:, 60:100, 60:100] = 2.0
    depth.requires_grad_()
    normals = depth_normals(depth, camera)
    assert torch.equal(normals[:, :58, :], torch.zeros(3, 58, WIDTH))
    normals.sum().backward()
    assert depth.grad is not None
    assert bool(torch.isfinite(depth.grad).all())
    assert torch.equal(depth.grad[:, :58], torch.zeros(1, 58, WIDTH))
    assert not depth_normals(torch.ones(1, 2, 9), camera).any()


def test_surface_depth_blends_expected_and_median() -> None:
    maps = {
        "expected": torch.tensor([[[2.0, float("nan"), 0.0]]]),
        "median": torch.tensor([[[3.0, 1.0, float("inf")]]]),
    }
    assert surface_depth(maps, 0.0).tolist() == [[[2.0, 0.0, 0.0]]]
    assert surface_depth(maps, 1.0).tolist() == [[[3.0, 1.0, 0.0]]]
    assert surface_depth(maps, 0.25).tolist() == [[[2.25, 0.25, 0.0]]]
    assert surface_depth({"median": maps["median"]}, 1.0).tolist() == [[[3.0, 1.0, 0.0]]]


def test_surface_depth_names_what_is_missing() -> None:
    with pytest.raises(ConfigError, match="needs the median depth"):
        surface_depth({"expected": torch.ones(1, 2, 2)}, 0.5)
    with pytest.raises(ConfigError, match=r"depth_ratio is 1\.5"):
        surface_depth({}, 1.5)


def test_world_normals_turn_and_keep_their_length() -> None:
    camera = camera_at((4.0, 5.0, 6.0))
    drawn = torch.rand(3, 4, 5, generator=torch.Generator().manual_seed(0))
    turned = world_normals(drawn, camera)
    assert torch.allclose(torch.einsum("ij,jhw->ihw", camera.R, turned), drawn, atol=1e-6)
    assert torch.allclose(turned.norm(dim=0), drawn.norm(dim=0), atol=1e-6)
