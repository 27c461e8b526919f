"""The demo scene: complete, exact, deterministic."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from sw_datasets.demo.raycast import eye_of
from sw_datasets.demo.shapes import dot
from sw_datasets.demo.synthetic import SIZES, build_world, make_scene


def digest(scene) -> str:
    sha = hashlib.sha256()
    for view in sorted(scene.train + scene.test, key=lambda v: v.name):
        sha.update(view.pixels.numpy().tobytes())
        sha.update(view.camera.R.numpy().tobytes() + view.camera.tau.numpy().tobytes())
    sha.update(scene.points.xyz.numpy().tobytes() + scene.points.rgb.numpy().tobytes())
    sha.update(scene.ground_truth["points"].numpy().tobytes())
    return sha.hexdigest()


def test_demo_has_60_training_and_12_test_views(load):
    scene = load("demo")
    assert (len(scene.train), len(scene.test)) == (60, 12)
    assert {(v.camera.width, v.camera.height) for v in scene.train + scene.test} == {(256, 192)}
    assert len(scene.points) == 5000
    assert scene.points.xyz.dtype == scene.points.rgb.dtype == torch.float32
    assert scene.ground_truth["points"].shape == scene.ground_truth["normals"].shape == (20_000, 3)
    assert len(scene.ground_truth["depth"]) == 72
    assert 3 < scene.extent < 7
    assert scene.warnings == []
    assert scene.protocol.id == "demo/256x192/r-1/every6/black/pp-center/q8"
    assert not any("pixels" in v.__dict__ for v in scene.train), "pictures are drawn on first use"


def test_tiny_demo_has_6_training_and_2_test_views(tiny):
    assert (tiny.name, len(tiny.train), len(tiny.test), len(tiny.points)) == ("demo-tiny", 6, 2, 600)
    assert tiny.train[0].pixels.shape == (3, 48, 64)
    assert tiny.train[0].pixels.dtype == torch.uint8


def test_every_view_shows_something_and_no_two_are_alike(tiny):
    pictures = [v.pixels.float() for v in tiny.train + tiny.test]
    assert all(p.std() > 20 for p in pictures)
    assert min((a - b).abs().mean() for i, a in enumerate(pictures) for b in pictures[:i]) > 3


def test_equal_seeds_give_equal_bits_in_another_process_with_other_threads(tmp_path, monkeypatch):
    code = (
        "import sys; sys.path.insert(0, sys.argv[1]); from test_synthetic import digest\n"
        "from sw_datasets.demo.synthetic import SIZES, make_scene\n"
        "print(digest(make_scene(SIZES['tiny'])))"
    )
    # Each with a cache of its own: neither reads what the other drew.
    monkeypatch.setenv("SPLATWIZARD_CACHE", str(tmp_path / "here"))
    there = str(tmp_path / "there")
    env = {**os.environ, "OMP_NUM_THREADS": "2", "OPENBLAS_NUM_THREADS": "2", "SPLATWIZARD_CACHE": there}
    command = [sys.executable, "-c", code, os.path.dirname(__file__)]
    other = subprocess.run(command, capture_output=True, text=True, env=env, check=True).stdout.strip()
    assert digest(make_scene(SIZES["tiny"])) == other


def test_seeds_change_what_they_name():
    first, layout, start = (make_scene(SIZES["tiny"], **kw) for kw in ({}, {"seed": 1}, {"init_seed": 1}))
    assert not torch.equal(first.train[0].pixels, layout.train[0].pixels)
    assert torch.equal(first.train[0].pixels, start.train[0].pixels)
    assert not torch.equal(first.points.xyz, start.points.xyz)


def test_depth_is_exact(tiny):
    world = build_world(0)
    for view in tiny.test:
        depth = tiny.ground_truth["depth"][view.name].double()[0]
        assert depth.shape == (48, 64)
        c = view.camera
        v, u = torch.nonzero(depth > 0, as_tuple=True)
        z = depth[v, u]
        assert len(z) > 1000
        x = torch.stack([(u + 0.5 - c.cx) / c.fx * z, (v + 0.5 - c.cy) / c.fy * z, z])
        p = (c.R.double().T @ (x - c.tau.double()[:, None])).numpy()
        way = p - eye_of(c)
        way /= np.sqrt(dot(way, way))

        def inside_any(q):
            return np.any([s.shape.contains(s.shape.to_local(q)) for s in world.solids], axis=0)

        # 1e-5: depths and rotations are float32, and points lie some 5 units away.
        assert inside_any(p - 1e-5 * way).mean() == 0
        assert inside_any(p + 1e-5 * way).mean() > 0.995  # grazing rays may have left again


def test_surface_samples_are_on_visible_surfaces_with_outward_normals(tiny):
    world = build_world(0)
    p = tiny.ground_truth["points"].double().numpy().T
    n = tiny.ground_truth["normals"].double().numpy().T
    assert p.shape[1] == 2000
    assert p[2].min() > -1e-6
    inner = np.zeros(p.shape[1], dtype=bool)
    for solid in world.solids:
        assert not solid.shape.contains(solid.shape.to_local(p + 1e-5 * n)).any()
        inner |= solid.shape.contains(solid.shape.to_local(p - 1e-5 * n))
    assert inner.mean() > 0.995  # all but points within 10 micrometres of an edge


def test_the_distance_to_the_scene_is_zero_on_its_samples_and_grows_along_their_normals(tiny):
    points, normals = (tiny.ground_truth[name].double().numpy() for name in ("points", "normals"))
    distance = tiny.ground_truth["distance"]
    assert np.abs(distance(points)).max() < 1e-6
    out = distance(points + 0.01 * normals)
    assert np.median(out) == pytest.approx(0.01)
    assert out.max() < 0.01 + 1e-6  # less where another solid is nearer
    assert distance(np.array([[0.0, 0.0, 9.0]])) == pytest.approx(9 - 0.52 * 2, abs=0.05)  # above the large sphere


def test_normal_maps_belong_to_the_depth_maps(tiny):
    from sw_gaussians.surface import depth_normals

    angles = []
    for view in tiny.test:
        depth, normals = (tiny.ground_truth[kind][view.name] for kind in ("depth", "normal_maps"))
        assert torch.equal(depth[0] > 0, normals.norm(dim=0) > 0.5)
        cosine = (depth_normals(depth, view.camera) * normals).sum(dim=0)[depth[0] > 0]
        angles.append(torch.rad2deg(torch.acos(cosine.clamp(-1, 1))))
    assert torch.cat(angles).median() < 0.6  # of 64 x 48 pixels; spheres are coarse there


def test_start_points_lie_near_the_surfaces_with_the_colours_of_the_pictures(tiny):
    surface = cKDTree(make_scene(SIZES["tiny"]).ground_truth["points"].numpy())
    away, _ = surface.query(tiny.points.xyz.numpy())
    assert np.median(away) < 0.08  # 2,000 samples are some 0.1 apart
    assert 0 <= tiny.points.rgb.min() < tiny.points.rgb.max() <= 1
    view = tiny.test[0]
    c, depth = view.camera, tiny.ground_truth["depth"][view.name][0]
    x = tiny.points.xyz @ c.R.T + c.tau
    u, v = (c.fx * x[:, 0] / x[:, 2] + c.cx).long(), (c.fy * x[:, 1] / x[:, 2] + c.cy).long()
    shown = (u >= 0) & (u < c.width) & (v >= 0) & (v < c.height)
    u, v, z, rgb = u[shown], v[shown], x[shown, 2], tiny.points.rgb[shown]
    seen = (depth[v, u] - z).abs() < 0.05
    assert seen.sum() > 100
    picture = view.image()[:, v[seen], u[seen]].T
    assert (picture - rgb[seen]).abs().mean() < 0.12
    shuffled = rgb[seen][torch.randperm(int(seen.sum()), generator=torch.Generator().manual_seed(0))]
    assert (picture - rgb[seen]).abs().mean() < 0.7 * (picture - shuffled).abs().mean()


def test_a_white_background_shows_behind_the_stage(load):
    black, white = load("demo:tiny"), load("demo:tiny", background="white")
    name = black.test[0].name
    behind = black.ground_truth["depth"][name][0] == 0
    row, column = torch.nonzero(behind)[0].tolist()
    assert black.test[0].pixels[:, row, column].tolist() == [0, 0, 0]
    assert white.test[0].pixels[:, row, column].tolist() == [255, 255, 255]
    assert white.background.tolist() == [1, 1, 1]


def test_options_reach_the_demo(load):
    scene = load("demo:tiny", resolution=2, split="all", seed=3)
    assert scene.train[0].pixels.shape == (3, 24, 32)
    assert len(scene.train) == len(scene.test) == 8
    assert scene.protocol.id == "demo/64x48/r2/all/black/pp-center/q8"
    assert len(load("demo:tiny", test_every=2).test) == 4


@pytest.mark.parametrize("variant", ["huge", "", "tiny/x"])
def test_an_unknown_variant_is_refused(load, variant):
    from splatwizard_core.errors import SceneError

    with pytest.raises(SceneError, match="use demo or demo:tiny"):
        load(f"demo:{variant}")
