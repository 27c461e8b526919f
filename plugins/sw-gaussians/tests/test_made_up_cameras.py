"""Cameras for scenes without any: objects, rooms, planes, one splat, far clusters; the closed rules to the digit."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from sw_gaussians.made_up_cameras import (
    MadeUpCameras,
    extent_of,
    extent_on_gpu,
    plausible_cameras,
    quantiles_on_gpu,
    weighted_quantiles,
)
from sw_gaussians.ring_cameras import ring_cameras, ring_extent
from sw_reference.rasterizer import ReferenceRasterizer

from splatwizard_core.api import Camera, GaussianModel, SceneError, stream
from sw_rasterizers.native import MODULE
from sw_rasterizers.standard import StandardRasterizer

RASTERIZER = StandardRasterizer() if MODULE.available() is None else ReferenceRasterizer()


def model_of(means: torch.Tensor, scale: float | torch.Tensor, opacity: float = 0.95) -> GaussianModel:
    n = len(means)
    scales = torch.as_tensor(scale, dtype=torch.float32).expand(n, 3)
    return GaussianModel.from_tensors(
        means.float(), torch.zeros(n, 1, 3), torch.zeros(n, 0, 3),
        torch.full((n,), math.log(opacity / (1 - opacity))), scales.log(), torch.tensor([[1.0, 0, 0, 0]]).expand(n, 4),
    )  # fmt: skip


def ball(n: int = 300, seed: int = 0) -> torch.Tensor:
    """A solid one of radius 1."""
    random = stream(seed, "ball")
    points = torch.nn.functional.normalize(torch.randn(n, 3, generator=random), dim=1)
    return points * torch.rand(n, 1, generator=random) ** (1 / 3)


def room(walls: int = 16) -> torch.Tensor:
    step = torch.linspace(-2, 2, walls)
    a, b = (each.flatten() for each in torch.meshgrid(step, step, indexing="ij"))
    side = torch.full_like(a, 2.0)
    return torch.cat([torch.stack(each, 1) for each in (
        (side, a, b), (-side, a, b), (a, side, b), (a, -side, b), (a, b, side), (a, b, -side))])  # fmt: skip


ROOM = model_of(room(), 0.14)


def made(model: GaussianModel, **options: int) -> MadeUpCameras:
    return plausible_cameras(model, RASTERIZER, **{"fit": 4, "held_out": 2, "widest": 480, **options})


def test_an_object_is_seen_from_outside():
    found = made(model_of(ball(), 0.12), fit=5, held_out=3)
    assert (found.recipe, found.kind, len(found.fit), len(found.held_out)) == ("plausible", "object", 5, 3)
    away = torch.stack([camera.center.norm() for camera in found.fit + found.held_out])
    assert (away > 1.0).sum() >= 6


def test_a_room_is_mostly_seen_from_inside():
    found = made(ROOM, fit=8, held_out=4)
    assert found.kind == "room"
    inside = [bool((camera.center.abs() < 2.0).all()) for camera in found.fit]
    assert sum(inside) == 6
    assert any(bool((camera.center.abs() < 2.0).all()) for camera in found.held_out)


def test_a_hollow_ball_is_a_room():
    assert made(model_of(torch.nn.functional.normalize(ball(), dim=1), 0.12)).kind == "room"


def test_an_object_with_a_nook_is_no_room():
    """Six boards: around its middle nearly all is opaque, above them all is free."""
    a, b = (each.flatten() for each in torch.meshgrid(*[torch.linspace(-0.5, 0.5, 9)] * 2, indexing="ij"))
    side = torch.full_like(a, 0.5)
    box = torch.cat([torch.stack(each, 1) for each in (
        (side, a, b), (-side, a, b), (a, side, b), (a, -side, b), (a, b, side), (a, b, -side))])  # fmt: skip
    back = torch.stack([4 * a, 4 * b, -side], 1).repeat(2, 1)
    found = made(model_of(torch.cat([box * torch.tensor([0.6, 0.6, 1.0]), back]), 0.06))
    assert found.kind == "object"


@pytest.mark.parametrize(("grow", "kind"), [(True, "room"), (False, "object")])
def test_where_gaussians_grow_with_the_distance_cameras_stood_between_them(grow, kind):
    """A table and what is around it; two sides are open, so few directions are opaque."""
    radii = torch.linspace(math.log(0.3), math.log(4), 3000).exp()[:, None]
    directions = torch.nn.functional.normalize(ball(3000), dim=1)
    points = (radii * directions)[directions[:, 0].abs() < 0.6]
    sizes = 0.06 * points.norm(dim=1, keepdim=True) if grow else torch.full((len(points), 1), 0.1)
    assert made(model_of(points, sizes)).kind == kind


def test_no_camera_is_both_fitted_and_held_out():
    found = made(ROOM, fit=8, held_out=4)
    fitted = {camera.pose for camera in found.fit}
    assert len(fitted) == 8
    assert not fitted & {camera.pose for camera in found.held_out}


def test_the_same_scene_gives_the_same_cameras():
    poses = [[camera.pose for camera in made(model_of(ball(), 0.12)).fit] for _ in range(2)]
    assert poses[0] == poses[1]


def test_pixels_are_as_large_as_the_median_splat():
    wide = made(model_of(ball(), 0.004), widest=1600)
    narrow = made(model_of(ball(), 0.004), widest=640)
    camera = next(c for c in wide.fit if 500 < c.width < 1500)
    assert camera.fx * 0.004 / float(camera.center.norm()) == pytest.approx(1, rel=0.2)
    assert max(c.width for c in narrow.fit) <= 640
    assert min(c.width for c in narrow.fit) >= 480


PLANE = torch.cat([4 * torch.rand(200, 2, generator=stream(1, "plane")), torch.zeros(200, 1)], 1)
CLUSTERS = torch.cat([ball(100) * 0.5, ball(100, 1) * 0.5 + torch.tensor([1e6, 0, 0])])


@pytest.mark.parametrize(
    ("means", "scale"),
    [
        (PLANE, torch.tensor([0.15, 0.15, 1e-6])),
        (torch.zeros(1, 3), 0.3),
        (torch.ones(50, 3), 0.1),
        (CLUSTERS, 0.1),
        (CLUSTERS[:130], 0.1),
    ],
    ids=["plane", "one splat", "one place", "two clusters", "a cluster and a far smaller one"],
)
def test_odd_scenes_have_cameras_that_see_them(means: torch.Tensor, scale: float | torch.Tensor):
    model = model_of(means, scale)
    found = made(model)
    assert len(found.fit) + len(found.held_out) == 6
    for camera in found.fit + found.held_out:
        assert all(map(math.isfinite, camera.pose))
        radii = RASTERIZER.visible_filter(model.gaussians(camera, RASTERIZER), camera)
        assert bool((radii > 0).any())


def test_nothing_to_see_is_an_error():
    with pytest.raises(SceneError, match="nothing to look at"):
        made(model_of(torch.full((3, 3), math.nan), 0.1))


def test_weighted_quantiles_count_weights():
    found = weighted_quantiles(np.array([3.0, 1.0, 2.0]), np.array([1.0, 1.0, 8.0]), (0.05, 0.5, 1.0))
    assert found.tolist() == [1.0, 2.0, 3.0]


def test_extents_on_a_gpu_are_those_of_arrays():
    random = np.random.default_rng(0)
    points, areas, sizes = random.normal(size=(6000, 3)), random.lognormal(size=6000), random.lognormal(-4, 1, 6000)
    known, found = extent_of(points, areas, sizes), extent_on_gpu(*map(torch.from_numpy, (points, areas, sizes)))
    assert found.center.tolist() == known.center.tolist()
    assert (found.r50, found.r80, found.r95) == pytest.approx((known.r50, known.r80, known.r95), rel=1e-12)
    same = quantiles_on_gpu(torch.tensor([3.0, 1.0, 2.0]), torch.tensor([1.0, 1.0, 8.0]).double(), (0.05, 0.5, 1.0))
    assert same.tolist() == [1.0, 2.0, 3.0]


@pytest.mark.cuda
def test_cameras_on_a_gpu_are_those_on_the_cpu():
    found, known = made(ROOM.cuda(), widest=640), made(ROOM, widest=640)
    assert found.kind == known.kind
    for ours, theirs in zip(found.fit + found.held_out, known.fit + known.held_out, strict=True):
        assert (ours.width, ours.height) == (theirs.width, theirs.height)
        assert ours.pose == pytest.approx(theirs.pose, abs=1e-4)


def cube(n: int = 21) -> GaussianModel:
    """A cube of side 2 with uniform weights."""
    step = torch.linspace(-1, 1, n)
    return model_of(torch.stack(torch.meshgrid(step, step, step, indexing="ij"), -1).reshape(-1, 3), 0.05)


def test_the_extent_of_a_cube_is_known():
    center, half = ring_extent(cube())
    assert center == pytest.approx(np.zeros(3), abs=1e-6)
    assert half == pytest.approx(np.full(3, 0.9), abs=0.05)  # a grid of 21 has its quantiles between two planes


def test_a_ring_keeps_its_distance_and_looks_at_the_middle():
    cameras = ring_cameras(cube(), "orbit16")
    center, half = ring_extent(cube())
    away = 1.05 * float(np.linalg.norm(half)) / math.sin(math.radians(25))
    assert len(cameras) == 16
    for camera in cameras:
        eye = camera.center.double().numpy()
        assert np.linalg.norm(eye - center) == pytest.approx(away, rel=1e-5)
        assert np.dot(camera.R[2].double().numpy(), (center - eye) / away) == pytest.approx(1, abs=1e-5)
    assert (cameras[0].width, cameras[0].height) == (1280, 720)
    assert cameras[0].fov_y == pytest.approx(math.radians(50), abs=1e-6)
    elevations = [math.degrees(math.asin(-float(camera.center[1]) / away)) for camera in cameras]
    assert elevations == pytest.approx([10.0] * 8 + [35.0] * 8, abs=1e-3)


def test_cameras_inside_look_outwards():
    cameras = ring_cameras(cube(), "inside16")
    for camera in cameras:
        level = camera.center.double().numpy() * [1, 0, 1]
        assert np.dot(camera.R[2].double().numpy(), level / np.linalg.norm(level)) == pytest.approx(1, abs=1e-5)
        assert camera.fov_y == pytest.approx(math.radians(75), abs=1e-6)


@pytest.mark.parametrize("recipe", ["orbit16", "inside16"])
def test_a_larger_scene_has_cameras_farther_apart_and_as_many_turned(recipe: str):
    small, model = cube(), cube()
    model.means.data *= 8
    pairs: list[tuple[Camera, Camera]] = list(
        zip(ring_cameras(small, recipe), ring_cameras(model, recipe), strict=True)
    )
    for a, b in pairs:
        assert (8 * a.center - b.center).abs().max() < 1e-4
        assert (a.R - b.R).abs().max() < 3e-6  # both are rounded to six decimals


def test_the_order_of_splats_changes_no_camera():
    model = cube()
    turned = model_of(model.means.detach().flip(0), 0.05)
    for a, b in zip(ring_cameras(model, "orbit16"), ring_cameras(turned, "orbit16"), strict=True):
        assert a.pose == b.pose
