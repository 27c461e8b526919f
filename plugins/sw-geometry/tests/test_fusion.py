"""Fusion of depth maps, on a sphere and on the demo scene; needs Open3D (`make test-geometry`)."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from sw_geometry import build as building
from sw_geometry.build import build
from sw_geometry.chamfer import Truth, compare
from sw_geometry.clusters import cluster_of_triangles
from sw_geometry.depth import DepthView, as_depth_view
from sw_geometry.fusion import Fusion
from sw_geometry.legacy import LegacyFusion, works
from sw_geometry.nearest import to_triangles
from sw_geometry.open3d_import import import_open3d
from sw_geometry.parameters import Parameters, resolve
from sw_geometry.picture import caster_of, draw, save_pictures, turntable
from sw_geometry.settings import MeshSettings

from splatwizard_core.api import Camera, CapabilityError, SceneOptions, SplatwizardError, UserInputError, View
from splatwizard_core.tooling import load_plugins, load_scene

try:
    import_open3d()
except CapabilityError as error:
    pytest.skip(str(error), allow_module_level=True)

R = 0.5
PARAMETERS = Parameters(
    voxel_size=0.02, sdf_trunc=0.08, depth_trunc=5.0, mesh_res=1024, clusters=50, min_views=1, depth_ratio=0.0,
    alpha_min=0.5, mask=True, views="train", unbounded=False, cull="none", focus=(0, 0, 0), radius=2.0,
)  # fmt: skip


def ring(count: int, rise: float = 0.9) -> list[Camera]:
    """Cameras at distance 2 that look at the origin, from above and below in turn."""
    cameras = []
    for i in range(count):
        a, z = 2 * math.pi * i / count, rise * (-1) ** i
        level = math.sqrt(4 - z * z)
        eye = torch.tensor([level * math.cos(a), level * math.sin(a), z]).double()
        up = torch.tensor([0.0, 0, 1]).double()
        cameras.append(Camera.look_at(eye, torch.zeros(3).double(), up, width=320, height=240, fov_x=0.98))
    return cameras


def sphere_depth(camera: Camera) -> torch.Tensor:
    """[H,W] float32: exact z of the sphere of radius R about the origin; 0 beside it."""
    x = (torch.arange(camera.width, dtype=torch.float64) + 0.5 - camera.cx) / camera.fx
    y = (torch.arange(camera.height, dtype=torch.float64) + 0.5 - camera.cy) / camera.fy
    gy, gx = torch.meshgrid(y, x, indexing="ij")
    d = torch.stack([gx, gy, torch.ones_like(gx)], dim=2)
    a, b, c = (d * d).sum(2), (d * camera.tau).sum(2), (camera.tau * camera.tau).sum() - R * R
    root = b * b - a * c
    return torch.where(root > 0, (b - root.clamp(min=0).sqrt()) / a, 0).float()


def seen(camera: Camera, depth: torch.Tensor | None = None) -> DepthView:
    depth = sphere_depth(camera) if depth is None else depth
    return as_depth_view(View(camera, "v.png"), depth, torch.full((*depth.shape, 3), 0.5))


@pytest.fixture(scope="module")
def views() -> list[DepthView]:
    return [seen(camera) for camera in ring(20)]


@pytest.fixture(scope="module")
def ball(views) -> building.Built:
    return build(views, len(views), PARAMETERS, label="test")


def error(built: building.Built) -> float:
    """Mean distance of the vertices from the sphere."""
    return float(np.abs(np.linalg.norm(built.post.vertices, axis=1) - R).mean())


def test_a_sphere_comes_out_as_one_closed_surface(ball):
    mesh = ball.post
    assert error(ball) < 0.002  # 0.0012 at this voxel, measured; half a pixel footprint is 0.003
    assert mesh.areas().sum() == pytest.approx(4 * math.pi * R**2, rel=0.02)
    edges = np.unique(np.sort(mesh.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    assert len(mesh.vertices) - len(edges) + len(mesh) == 2
    assert len(np.unique(cluster_of_triangles(mesh))) == 1
    assert ((mesh.crossed() * mesh.corners.mean(axis=1)).sum(axis=1) > 0).mean() > 0.999
    assert (ball.facts["views_used"], ball.facts["views_skipped"]) == (20, 0)
    assert np.abs(mesh.colors - 0.5).max() < 0.01


def test_equal_views_give_bitwise_equal_meshes(views, ball):
    again = build(views, len(views), PARAMETERS, label="test")
    for name in ("vertices", "triangles", "normals", "colors"):
        assert np.array_equal(getattr(again.raw, name), getattr(ball.raw, name)), name


def test_the_order_of_views_does_not_matter(views, ball):
    turned = build(views[::-1], len(views), PARAMETERS, label="test")
    assert len(turned.post) == pytest.approx(len(ball.post), rel=1e-3)
    assert to_triangles(turned.post.vertices[::7], ball.post)[0].max() < 0.01 * PARAMETERS.voxel_size


def moved(view: DepthView, scale: float, offset: tuple[float, float, float]) -> DepthView:
    """The view of a world that is scaled, then shifted."""
    E = view.E.copy()
    E[:3, 3] = scale * E[:3, 3] - E[:3, :3] @ np.array(offset)
    return replace(view, depth=(scale * view.depth).astype(np.float32), E=E)


def test_a_scaled_and_a_shifted_world_have_the_same_mesh(views, ball):
    """Powers of two, and whole blocks: nothing is rounded otherwise than before."""
    larger = replace(PARAMETERS, voxel_size=0.08, sdf_trunc=0.32, depth_trunc=20.0)
    scaled = build([moved(v, 4.0, (0, 0, 0)) for v in views], len(views), larger, label="test")
    assert scaled.post.vertices == pytest.approx(4 * ball.post.vertices, abs=1e-5)
    block = 16 * PARAMETERS.voxel_size
    shifted = build(
        [moved(v, 1.0, (2 * block, -block, 3 * block)) for v in views], len(views), PARAMETERS, label="test"
    )
    there = shifted.post.vertices - np.array([2, -1, 3]) * block
    assert len(there) == pytest.approx(len(ball.post.vertices), rel=2e-3)
    assert to_triangles(there[::7], ball.post)[0].max() < 0.02 * PARAMETERS.voxel_size


def test_views_without_depth_are_counted_and_change_nothing(views, ball):
    empty = [replace(views[0], depth=np.full_like(views[0].depth, value)) for value in (0, np.nan, np.inf, 9.0)]
    with_them = build([*empty, *views], len(views) + 4, PARAMETERS, label="test")
    assert with_them.facts["views_skipped"] == 4
    assert np.array_equal(with_them.raw.vertices, ball.raw.vertices)


@pytest.mark.parametrize("mistake", ["half a pixel", "along the ray", "long truncation"])
def test_a_known_mistake_shows(mistake):
    """Mutations: each of these is easily made, and costs accuracy."""
    cameras, parameters = ring(12), replace(PARAMETERS, voxel_size=0.01, sdf_trunc=0.04)
    right = build([seen(c) for c in cameras], 12, parameters, label="test")
    if mistake == "half a pixel":
        wrong = [seen(replace(c, cx=c.cx - 0.5), sphere_depth(c)) for c in cameras]
    elif mistake == "along the ray":
        x = (torch.arange(320) + 0.5 - 160) / cameras[0].fx
        y = (torch.arange(240) + 0.5 - 120) / cameras[0].fy
        wrong = [seen(c, sphere_depth(c) * (1 + x[None] ** 2 + y[:, None] ** 2).sqrt()) for c in cameras]
    else:
        parameters, wrong = replace(parameters, sdf_trunc=0.08), [seen(c) for c in cameras]
    assert error(build(wrong, 12, parameters, label="test")) > 1.15 * error(right)


def test_a_plane_lies_where_it_is():
    """A tilted plane at z = 2: half a pixel in the principal point would move it by half a pixel."""
    camera = Camera(320, 240, 300.0, 300.0, 160.0, 120.0, torch.eye(3).double(), torch.zeros(3).double())
    x = ((torch.arange(320) + 0.5 - 160) / 300).expand(240, -1)
    built = build([seen(camera, (2 / (1 - x)).float())], 1, replace(PARAMETERS, depth_trunc=4.0), label="test")
    v = built.post.vertices
    inner = v[(np.abs(v[:, 0]) < 0.5) & (np.abs(v[:, 1]) < 0.5)]
    offset = (inner[:, 2] - inner[:, 0] - 2) / math.sqrt(2)
    assert abs(offset.mean()) < 0.0008  # a quarter of what half a pixel makes: 0.5 * 2 / 300 / sqrt(2)


def test_a_surface_that_one_view_saw_needs_one_view(views):
    assert len(build(views[:1], 1, PARAMETERS, label="test").post)
    with pytest.raises(SplatwizardError, match="no surface: raise depth_trunc"):
        build(views[:1], 1, replace(PARAMETERS, min_views=2), label="test")
    assert len(build([views[0], views[0]], 2, replace(PARAMETERS, min_views=2), label="test").post)


def test_nothing_to_see_is_told(views):
    with pytest.raises(SplatwizardError, match=r"no surface: .*0 of 20 views show something"):
        build(views, len(views), replace(PARAMETERS, depth_trunc=0.5), label="test")


def test_memory_is_refused_before_it_is_taken(views):
    with pytest.raises(UserInputError, match=r"voxel_size 0\.002 needs more than .* GB .* try 0\.0"):
        build(views, len(views), replace(PARAMETERS, voxel_size=0.002, sdf_trunc=0.008), max_memory=0.3, label="test")


def test_the_estimate_counts_the_room_that_is_there():
    fusion = Fusion(voxel_size=0.02, truncation=4, depth_trunc=5, max_bytes=1e9)
    before = fusion.estimated_bytes
    view = seen(ring(1)[0])
    fusion.add(view.depth, view.color, view.K, view.E)
    assert before == fusion._grid.hashmap().capacity() * 81_920
    assert fusion.estimated_bytes > before
    assert len(fusion._blocks) == fusion._grid.hashmap().size()


def test_a_picture_shows_the_outside_in_grey_and_the_inside_in_red(ball):
    camera, caster = ring(1)[0], caster_of(ball.post)
    picture = draw(ball.post, camera, caster).astype(int)
    assert (picture[0, 0] == 255).all()
    grey = picture[120, 160]
    assert grey[0] == grey[1] == grey[2] == pytest.approx(0.75 * 255, abs=4)
    assert np.abs((picture.sum(axis=2) < 765) ^ (sphere_depth(camera).numpy() > 0)).mean() < 0.01
    inside_out = replace(ball.post, triangles=ball.post.triangles[:, ::-1])
    assert np.ptp(draw(inside_out, camera, caster_of(inside_out))[120, 160].astype(int)) > 20
    assert draw(ball.post, camera, caster, colored=True)[120, 160] == pytest.approx(128, abs=3)


def test_the_pictures_of_a_file_go_around(ball, tmp_path):
    cameras = ring(20, rise=0.3)
    chosen = turntable(cameras, 4)
    angles = sorted(math.atan2(c.center[1], c.center[0]) for c in chosen)
    assert np.diff(angles) == pytest.approx(math.pi / 2, abs=0.01)
    save_pictures(ball.post, cameras, tmp_path / "mesh.png")
    with Image.open(tmp_path / "mesh.png") as picture:
        assert picture.size == (4 * 320, 2 * 240)
    assert len(turntable(cameras[:2], 4)) == 2


@pytest.fixture(scope="module")
def demo():
    return load_scene("demo", SceneOptions(), load_plugins())


@pytest.mark.slow
def test_the_chamfer_distance_of_exact_depth_falls_with_the_voxel(demo):
    """The bounds of the specification for 256 x 192: accuracy below a twentieth of voxel and pixel footprint."""
    truth, views = Truth.of(demo), [*demo.train, *demo.test]
    exact = [(view, demo.ground_truth["depth"][view.name][0]) for view in views]
    overall = []
    for voxel in (0.08, 0.04, 0.02):
        settings = MeshSettings(voxel_size=voxel, sdf_trunc=4 * voxel, depth_trunc=9.0, min_views=2)
        seen_views = (as_depth_view(view, d, torch.full((*d.shape, 3), 0.5)) for view, d in exact)
        built = build(seen_views, len(views), resolve(settings, demo, {}), label="test")
        found = compare(built.post, truth, 0.02)
        overall.append(found["overall"])
        if voxel < 0.08:  # thinner than the thinnest solid
            assert found["acc"] < 1.3 * (0.05 * voxel + 0.05 * 0.014)
            assert found["f1"] > 0.95
    assert overall == sorted(overall, reverse=True)


def test_distances_to_triangles_agree_with_open3d(ball):
    """An independent check of the Chamfer code."""
    queries = np.random.default_rng(0).normal(size=(2000, 3)) * 0.4
    theirs = caster_of(ball.post).compute_distance(import_open3d().core.Tensor(queries.astype(np.float32))).numpy()
    assert to_triangles(queries, ball.post)[0] == pytest.approx(theirs, abs=2e-6)  # theirs is float32


needs_legacy = pytest.mark.skipif(
    not works(import_open3d()), reason="Open3D 0.20 extracts nothing with its older class"
)


@pytest.mark.skipif(works(import_open3d()), reason="it works with this Open3D")
def test_where_the_class_does_not_work_it_is_refused_in_one_line():
    with pytest.raises(CapabilityError, match=r"legacy backend .* pip install 'open3d-cpu<0\.20'"):
        build([], 0, replace(PARAMETERS, backend="legacy"), label="test")


@needs_legacy
def test_both_backends_make_the_same_sphere(views, ball):
    """Half a pixel in the principal point, which the two count differently, would make them differ by 0.0012."""
    older = build(views, len(views), replace(PARAMETERS, backend="legacy"), label="test")
    assert error(older) == pytest.approx(error(ball), rel=0.1)
    assert len(older.post) == pytest.approx(len(ball.post), rel=0.02)
    assert "ScalableTSDFVolume" in older.facts["backend"]
    assert np.abs(older.post.colors - 0.5).max() < 0.01
    assert ((older.post.crossed() * older.post.corners.mean(axis=1)).sum(axis=1) > 0).mean() > 0.999


@needs_legacy
def test_it_keeps_what_any_view_saw_and_no_other_rule(views):
    volume = LegacyFusion(voxel_size=0.05, sdf_trunc=0.2, depth_trunc=5.0)
    view = views[0]
    volume.add(np.zeros_like(view.depth), view.color, view.K, view.E)
    assert (volume.used, volume.skipped) == (0, 1)
    volume.add(view.depth, view.color, view.K, view.E)
    assert len(volume.mesh(min_views=1)) > 100
    with pytest.raises(UserInputError, match="min_views is 2"):
        volume.mesh(min_views=2)
