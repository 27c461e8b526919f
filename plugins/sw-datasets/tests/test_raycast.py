"""Analytic solids against an oracle that knows only what is inside: march along the ray, then bisect."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from sw_datasets.demo.raycast import Solid, World, camera_rays, depth_map, draw, eye_of, sky
from sw_datasets.demo.shapes import Box, Cylinder, Sphere, Torus, dot, normalize, rotation_x, rotation_z
from sw_datasets.demo.synthetic import build_world, orbit
from sw_datasets.demo.textures import Material, bands, checker, dots, marble, noise, planks

TILTED = rotation_z(0.7) @ rotation_x(0.4)
SHAPES = {
    "sphere": Sphere((0.1, -0.2, 0.3), TILTED, r=0.6),
    "box": Box((0.1, -0.2, 0.3), TILTED, half=(0.5, 0.3, 0.2)),
    "cylinder": Cylinder((0.1, -0.2, 0.3), TILTED, r=0.3, half_height=0.5),
    "torus": Torus((0.1, -0.2, 0.3), TILTED, ring=0.5, tube=0.15),
}


@pytest.fixture(params=SHAPES)
def shape(request):
    return SHAPES[request.param]


def inside(shape, p):
    return shape.contains(shape.to_local(p))


def first_entry(shape, o, d, far=4.0, steps=4000):
    """Distance [n] to the first change from outside to inside, inf if there is none among `steps` looks."""
    found = np.full(d.shape[1], np.inf)
    for k in range(1, steps + 1):
        t = far * k / steps
        new = np.isinf(found) & inside(shape, o + t * d)
        found[new] = t
    low, high = found - far / steps, found.copy()
    hit = np.isfinite(found)
    for _ in range(40):
        middle = (low + high) / 2
        within = inside(shape, o + np.where(hit, middle, 0) * d)
        high, low = np.where(within, middle, high), np.where(within, low, middle)
    return high


def test_a_hit_is_the_first_entry_into_the_solid(shape):
    rng = np.random.default_rng(1)
    o = 2 * normalize(rng.normal(size=(3, 400)))
    target = np.array(shape.position)[:, None] + 0.45 * rng.normal(size=(3, 400))
    d = normalize(target - o)
    expected, found = first_entry(shape, o, d), shape.intersect(o, d)
    both = np.isfinite(expected) & np.isfinite(found)
    assert both.sum() > 100
    assert (~np.isfinite(expected)).sum() > 30
    # The oracle looks every 1 mm: it misses what is thinner, at most a few grazing rays.
    assert (np.isfinite(expected) != np.isfinite(found)).sum() <= 3
    np.testing.assert_allclose(found[both], expected[both], atol=1e-7)


def test_one_common_origin_gives_the_same_as_many_equal_ones(shape):
    o = np.array([[1.5], [-1.2], [0.8]])
    d = normalize(np.array(shape.position)[:, None] + 0.4 * np.random.default_rng(2).normal(size=(3, 300)) - o)
    t = shape.intersect(o, d)
    assert np.isfinite(t).sum() > 50
    np.testing.assert_array_equal(t, shape.intersect(np.repeat(o, 300, axis=1), d))


def test_rays_along_the_axes_and_inside_faces_do_not_fail(shape):
    o = np.array(shape.position)[:, None] + shape.rotate_out(np.array([[-3.0, 0, 0], [0, -3, 0], [0, 0, -3]]).T)
    t = shape.intersect(o, shape.rotate_out(np.eye(3)))
    assert not np.isnan(t).any()
    edge = Box(half=(1.0, 1.0, 1.0)).intersect(np.array([[1.0], [-5.0], [0.0]]), np.array([[0.0], [1.0], [0.0]]))
    assert not np.isnan(edge).any()


def test_samples_lie_on_the_surface_and_normals_point_out(shape):
    p = shape.to_world(shape.sample(2000, torch.Generator().manual_seed(3)))
    n = shape.rotate_out(shape.normal(shape.to_local(p)))
    np.testing.assert_allclose(dot(n, n), 1, atol=1e-12)
    edge = inside(shape, p + 1e-6 * n) | ~inside(shape, p - 1e-6 * n)
    assert edge.mean() < 1e-3  # but for points within a micrometre of an edge
    assert np.sqrt(((p - np.array(shape.position)[:, None]) ** 2).sum(0)).max() <= shape.radius + 1e-9


@pytest.mark.parametrize(
    ("shape", "share", "expected"),
    [
        (Sphere(r=2.0), lambda p: p[2] > 1.0, 0.25),  # Archimedes: area goes with height
        (Box(half=(1.0, 2.0, 3.0)), lambda p: np.abs(np.abs(p[0]) - 1) < 1e-12, 6 / 11),
        (Cylinder(r=1.0, half_height=1.0), lambda p: p[2] == 1.0, 1 / 6),
        (Torus(ring=1.0, tube=0.5), lambda p: p[0] ** 2 + p[1] ** 2 > 1, 0.5 + 0.5 / math.pi),
    ],
)
def test_samples_are_uniform_by_area(shape, share, expected):
    p = shape.sample(20_000, torch.Generator().manual_seed(4))
    assert p.shape == (3, 20_000)
    assert share(p).mean() == pytest.approx(expected, abs=4 * math.sqrt(expected * (1 - expected) / 20_000))


def test_areas_are_those_of_the_textbook():
    assert Sphere(r=2.0).area == pytest.approx(16 * math.pi)
    assert Box(half=(1.0, 2.0, 3.0)).area == pytest.approx(88)
    assert Cylinder(r=1.0, half_height=1.0).area == pytest.approx(6 * math.pi)
    assert Torus(ring=1.0, tube=0.5).area == pytest.approx(2 * math.pi**2)


TEXTURES = {
    "checker": checker((1, 0, 0), (0, 1, 0), size=0.1, edge=0.01, seed=1),
    "marble": marble((1, 0, 0), (0, 1, 0), scale=2.0, seed=1),
    "bands": bands(((1, 0, 0), (0, 1, 0), (0, 0, 1)), width=0.1, edge=0.01, seed=1),
    "dots": dots((1, 0, 0), (0, 1, 0), spacing=0.2, size=0.3, seed=1),
    "planks": planks((0.6, 0.4, 0.2), (0.3, 0.2, 0.1), width=0.2, seed=1),
}


@pytest.mark.parametrize("name", TEXTURES)
def test_textures_stay_in_range_vary_and_are_continuous(name):
    rng = np.random.default_rng(5)
    p = rng.uniform(-2, 2, (3, 5000))
    colour = TEXTURES[name](p)
    assert colour.shape == (3, 5000)
    assert colour.min() >= 0
    assert colour.max() <= 1
    assert colour.std() > 0.02
    # Boards of wood differ by design at their joints; everything else has no jump.
    jump = np.abs(TEXTURES[name](p + 1e-7) - colour).max(axis=0)
    assert (jump > 1e-3).mean() <= (0.01 if name == "planks" else 0)


def test_noise_is_smooth_value_noise_between_0_and_1():
    p = np.random.default_rng(6).uniform(-50, 50, (3, 20_000))
    values = noise(p, 7)
    assert 0 <= values.min() < 0.1
    assert 0.9 < values.max() < 1
    assert values.mean() == pytest.approx(0.5, abs=0.02)
    assert abs(np.corrcoef(values, noise(p, 8))[0, 1]) < 0.05


def matte(colour):
    return Material(lambda p: np.broadcast_to(np.array(colour)[:, None], p.shape))


def test_the_nearer_of_two_solids_is_hit():
    world = World(
        [Solid(Sphere((0, 0, 0), r=0.5), matte((1, 0, 0))), Solid(Sphere((2, 0, 0), r=0.5), matte((0, 1, 0)))]
    )
    o, d = np.array([[5.0, -5.0, 0.0], [0, 0, 5.0], [0, 0, 0]]), np.array([[-1.0, 1.0, 0.0], [0, 0, 1.0], [0, 0, 0]])
    t, which = world.trace(o, d)
    assert which.tolist() == [1, 0, -1]
    np.testing.assert_allclose(t[:2], [2.5, 4.5])
    assert np.isinf(t[2])


def test_what_stands_between_a_point_and_the_lamp_shades_it():
    floor = Solid(Cylinder((0, 0, -0.1), r=3.0, half_height=0.1), matte((0.5, 0.5, 0.5)), casts_shadow=False)
    world = World([floor, Solid(Sphere((0, 0, 1.0), r=0.3), matte((1, 1, 1)))])
    lamp = np.array([[0.0], [0.0], [4.0]])
    p = np.array([[0.0, 1.5], [0.0, 0.0], [0.0, 0.0]])
    rgb = world.shade(p, np.zeros(2, int), np.array([[0.0, 0.0], [0.0, 0.0], [1.0, 1.0]]), lamp)
    assert rgb[0, 0] < 0.7 * rgb[0, 1]


def test_gloss_depends_on_where_one_looks_from_and_matte_does_not():
    world = build_world(0)
    views = normalize(np.random.default_rng(8).normal(size=(3, 200)))
    views[2] = np.abs(views[2])
    lamp = world.lamp_point(0, 0)
    for index, changes in ((0, False), (1, True)):
        top = world.solids[index].shape.to_world(
            np.array([[0.0], [0.0], [0.06 if index == 0 else world.solids[1].shape.radius]])
        )
        p = np.repeat(top, 200, axis=1)
        rgb = world.shade(p, np.full(200, index), views, lamp)
        assert (rgb.max(axis=1) - rgb.min(axis=1)).max() > 0.05 if changes else np.ptp(rgb, axis=1).max() == 0


def test_the_sky_is_between_dark_and_bright_everywhere():
    d = normalize(np.random.default_rng(9).normal(size=(3, 500)))
    assert 0 <= sky(d).min() < sky(d).max() < 2


def test_camera_rays_pass_through_pixel_centres():
    camera = orbit(5, 20, 10)[2]
    d, z_of = camera_rays(camera)
    p = torch.from_numpy(eye_of(camera) + 3.0 * d)
    x = camera.R.double() @ p + camera.tau.double()[:, None]
    u = (camera.fx * x[0] / x[2] + camera.cx).reshape(10, 20)
    v = (camera.fy * x[1] / x[2] + camera.cy).reshape(10, 20)
    np.testing.assert_allclose(u[4], np.arange(20) + 0.5, atol=1e-5)  # R is float32
    np.testing.assert_allclose(v[:, 7], np.arange(10) + 0.5, atol=1e-5)
    np.testing.assert_allclose(x[2], 3.0 * z_of, atol=1e-6)


def test_depth_of_a_sphere_in_front_is_its_distance_less_its_radius():
    world = World([Solid(Sphere((0, 0, 0), r=0.5), matte((1, 1, 1)))])
    camera = orbit(1, 21, 21)[0]
    centre = camera.R.double() @ torch.zeros(3).double() + camera.tau.double()
    depth = depth_map(world, camera)
    assert depth.shape == (1, 21, 21)
    assert depth[0, 0, 0] == 0
    assert depth.max() > 0
    assert depth[depth > 0].min() >= float(centre[2]) - 0.5 - 1e-6


def test_the_background_shows_where_nothing_is():
    world = World([Solid(Sphere((0, 0, 0), r=0.1), matte((1, 0, 0)))])
    camera = orbit(1, 16, 12)[0]
    assert draw(world, camera, samples=1, background=1.0)[0, 0].tolist() == [255, 255, 255]
    assert draw(world, camera, samples=2, background=0.0)[0, 0].tolist() == [0, 0, 0]


def test_the_distance_is_that_to_the_nearest_point_of_the_surface(shape):
    from scipy.spatial import cKDTree

    p = np.array(shape.position)[:, None] + 0.7 * np.random.default_rng(4).normal(size=(3, 400))
    local = shape.to_local(p)
    distance = shape.distance(local)
    dense = shape.sample(40_000, torch.Generator().manual_seed(1))
    sampled, _ = cKDTree(dense.T).query(local.T)
    np.testing.assert_array_equal(distance < 0, shape.contains(local))
    assert (sampled - np.abs(distance)).min() > -1e-9
    assert (sampled - np.abs(distance)).max() < 0.06  # samples of it lie some 0.01 apart


def test_a_step_along_the_normal_is_as_far_as_it_is_long(shape):
    p = shape.sample(500, torch.Generator().manual_seed(5))
    np.testing.assert_allclose(shape.distance(p), 0, atol=1e-9)
    np.testing.assert_allclose(shape.distance(p + 0.03 * shape.normal(p)), 0.03, atol=1e-9)
