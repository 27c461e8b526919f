"""Depth, normals, ellipsoids: what a browser is shown of a model, from files of every kind."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from sw_view.entries import Opened, find_entries, open_entry
from sw_view.frames import camera_at, orientation_of
from sw_view.mode_pictures import MODES
from sw_view.shown_gaussians import ShownGaussians, shown_gaussians, sphere
from sw_view.shown_models import shown_model

from splatwizard_core.api import UserInputError
from splatwizard_core.tooling import Choices, load_plugins

GOLDEN = Path(__file__).parents[3] / "tests" / "golden"


@pytest.fixture(scope="module")
def opened() -> dict[str, Opened]:
    """A model of Gaussians, one of surfels, one of anchors."""
    plugins = load_plugins()
    files = {"gaussians": "3dgs_r3_v1.swz", "surfels": "2dgs_r3_v1.swz", "anchors": "hac_exact_v2.swz"}
    return {kind: open_entry(find_entries(GOLDEN / name)[0], Choices(), plugins) for kind, name in files.items()}


@pytest.mark.parametrize("kind", ["gaussians", "surfels", "anchors"])
@pytest.mark.parametrize("mode", MODES)
def test_every_model_is_shown_in_every_mode(opened, kind, mode):
    found = opened[kind]
    camera = found.around.cameras[0].camera.resized(48, 36)
    pixels = shown_model(found).draw(camera, mode)
    assert (pixels.shape, pixels.dtype) == ((36, 48, 3), np.uint8)
    assert pixels.max() > 0, "nothing is seen"
    assert "bytes" in shown_model(found).told()


def test_a_file_without_a_scene_has_cameras_of_its_own(opened):
    assert not opened["gaussians"].has_scene
    around = opened["gaussians"].around
    assert [each.name for each in around.cameras] == [f"made up, {i}" for i in range(1, 9)]
    assert 0 < around.size < 100


@pytest.mark.parametrize("kind", ["gaussians", "surfels", "anchors"])
def test_gaussians_are_handed_to_the_browser(opened, kind):
    found = opened[kind]
    shown = shown_gaussians(found.drawing.model, found.around.cameras[0].camera, found.drawing.rasterizer)
    n = len(shown.means)
    assert n > 0
    assert [v.shape for v in vars(shown).values()] == [(n, 3), (n, 4), (n, 3), (n, 3), (n, 1)]
    assert shown.colors.dtype == np.uint8
    np.testing.assert_allclose(np.linalg.norm(shown.quats, axis=1), 1, atol=1e-5)
    np.testing.assert_allclose(np.sort(np.linalg.eigvalsh(shown.covariances), axis=1),
                               np.sort(shown.scales**2, axis=1), rtol=1e-3, atol=1e-7)  # fmt: skip


def test_the_largest_are_those_that_cover_most():
    n = 10
    areas = np.array([5, 1, 9, 3, 2, 8, 7, 4, 6, 10], np.float32)
    opacities = np.full((n, 1), 0.9, np.float32)
    opacities[2] = 0.05  # faint
    shown = ShownGaussians(
        np.arange(3 * n, dtype=np.float32).reshape(n, 3), np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
        np.stack([areas, areas, np.full(n, 0.1)], axis=1).astype(np.float32), np.zeros((n, 3), np.uint8), opacities,
    )  # fmt: skip
    assert sorted(shown.largest(3).scales[:, 0].tolist()) == [7, 8, 10]
    assert len(shown.largest(100).means) == 9


def test_the_sphere_is_closed_round_and_faces_outwards():
    vertices, faces = sphere()
    assert (len(vertices), len(faces)) == (66, 128)
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 1, atol=1e-6)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    assert (np.einsum("ij,ij->i", np.cross(b - a, c - a), a + b + c) > 0).all()
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()


def test_paths_offer_files_runs_and_folders_of_runs(tmp_path):
    for name in ("a/r1", "a/r2", "b/r1"):
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / "scene.swz").write_bytes(b"")
        if name != "b/r1":
            (tmp_path / name / "config.toml").write_text("")
    assert [entry.label for entry in find_entries(tmp_path)] == ["a/r1", "a/r2"]
    (run,) = find_entries(tmp_path / "a" / "r1")
    assert run.run == tmp_path / "a" / "r1"
    (file,) = find_entries(tmp_path / "a" / "r1" / "scene.swz")
    assert file.run == tmp_path / "a" / "r1"
    (alone,) = find_entries(tmp_path / "b" / "r1" / "scene.swz")
    assert alone.run is None
    with pytest.raises(UserInputError, match="holds no finished run"):
        find_entries(tmp_path / "b")
    (tmp_path / "lod-meta.json").write_text("{}")
    assert [entry.file for entry in find_entries(tmp_path)] == [tmp_path / "lod-meta.json"]


def test_the_camera_of_a_browser_draws_like_one_of_the_scene(opened):
    found = opened["gaussians"]
    camera = found.around.cameras[0].camera.resized(48, 36)
    same = camera_at(orientation_of(camera), camera.center.numpy(), camera.fov_y, (48, 36))
    draw = shown_model(found).draw
    difference = np.abs(draw(camera, "picture").astype(int) - draw(same, "picture"))
    assert difference.max() <= 2  # float32 of the pose
    assert torch.allclose(same.R, camera.R, atol=1e-6)
