"""From a prepared DTU scan to millimetres: masks of its views, alignment, and the metric of evaluations."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.io import savemat
from small_meshes import sphere
from sw_geometry import dtu, dtu_scene, metrics
from sw_geometry.build import Built
from sw_geometry.mesh import Mesh
from sw_geometry.ply import write_mesh

from splatwizard_core.api import (
    Camera,
    CapabilityError,
    MetricSetup,
    Protocol,
    Scene,
    SceneError,
    UserInputError,
    View,
)

SCALE, OFFSET = 12.0, (10.0, -20.0, 600.0)
"""Millimetres of a unit of the scene, and where its origin lies."""
WIDTH, HEIGHT = 200, 150


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    """A unit sphere that four cameras see, with masks of what they see of it; names count 0000, masks 000."""
    folder = tmp_path / "scan24"
    (folder / "mask").mkdir(parents=True)
    scale = torch.eye(4).double()
    scale[:3, :3] *= SCALE
    scale[:3, 3] = torch.tensor(OFFSET)
    views, world = [], []
    for i in range(4):
        eye = torch.tensor([4 * math.cos(i), 4 * math.sin(i), 1.0]).double()
        up = torch.tensor([0.0, 0, 1]).double()
        camera = Camera.look_at(eye, torch.zeros(3).double(), up, width=WIDTH, height=HEIGHT, fov_x=0.9)
        views.append(View(camera, f"{i:04d}.png"))
        projection = torch.eye(4).double()
        projection[:3] = camera.K @ camera.viewmat[:3]
        world.append(projection @ torch.linalg.inv(scale))
        y, x = np.mgrid[:HEIGHT, :WIDTH]
        radius = camera.fx / math.sqrt(17 - 1)  # of the outline: tan of its half angle is 1 / sqrt(d^2 - 1)
        mask = (x - camera.cx) ** 2 + (y - camera.cy) ** 2 < (radius + 1) ** 2
        # Two of the three channels are black, and the mask is faint: any byte that is not zero counts.
        Image.fromarray(np.stack([0 * mask, 3 * mask, 0 * mask], axis=2).astype(np.uint8)).save(
            folder / "mask" / f"{i:03d}.png"
        )
    found = Scene("scan24", views, views, None, Protocol("dtu", split="all"), str(folder))
    found.ground_truth |= {"world_mats": torch.stack(world), "scale_mats": scale.repeat(4, 1, 1)}
    return found


def with_floater(mesh: Mesh) -> Mesh:
    """The mesh and a small triangle above it, outside every mask."""
    beside = np.array([[0.0, 0, 1.35], [0.1, 0, 1.35], [0, 0.1, 1.35]])
    rows = np.concatenate([mesh.triangles, [[len(mesh.vertices) + k for k in range(3)]]])
    return Mesh(np.concatenate([mesh.vertices, beside]), rows)


@pytest.fixture
def small_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """A disk of 3 px, as the masks are an eighth of DTU's width."""
    monkeypatch.setattr(dtu_scene, "RADIUS", 3)


@pytest.mark.usefixtures("small_disk")
def test_what_the_masks_rule_out_goes(scene):
    mesh = with_floater(sphere(20))
    assert len(dtu_scene.culled(mesh, scene, "none")) == len(mesh)
    for rule in ("all", "any"):
        left = dtu_scene.culled(mesh, scene, rule)
        assert len(left) == len(sphere(20)), rule
        assert np.array_equal(left.vertices, sphere(20).vertices)


def test_a_wider_disk_leaves_more(scene, monkeypatch):
    mesh = sphere(20, r=1.2)
    kept = []
    for radius in (0, 20, 60):
        monkeypatch.setattr(dtu_scene, "RADIUS", radius)
        kept.append(len(dtu_scene.culled(mesh, scene, "all")))
    assert kept[0] < kept[1] <= kept[2] == len(mesh)


def test_the_scene_becomes_millimetres_once(scene):
    there = dtu_scene.in_millimetres(sphere(10), scene)
    assert there.vertices.mean(axis=0) == pytest.approx(OFFSET, abs=1e-6)
    assert np.ptp(there.vertices[:, 2]) == pytest.approx(2 * SCALE)
    big = Mesh(there.vertices * 5, there.triangles)
    with pytest.raises(UserInputError, match="units wide: if it is in millimetres already, say --units mm"):
        dtu_scene.in_millimetres(big, scene)


def test_missing_masks_and_alignments_are_named(scene):
    (Path(scene.path) / "mask" / "001.png").unlink()
    with pytest.raises(SceneError, match=r"mask: 3 masks for 4 cameras; without them say --cull none"):
        dtu_scene.culled(sphere(5), scene, "all")
    del scene.ground_truth["scale_mats"]
    with pytest.raises(SceneError, match=r"has no cameras\.npz"):
        dtu_scene.in_millimetres(sphere(5), scene)


def official(folder: Path) -> Path:
    """Official files whose truth is the unit sphere of the scene, in millimetres, on a table far below."""
    (folder / "Points" / "stl").mkdir(parents=True)
    (folder / "ObsMask").mkdir()
    truth = sphere(200).moved(SCALE, np.array(OFFSET))
    write_mesh(Mesh(truth.vertices, np.zeros((0, 3), dtype=np.int64)), folder / "Points" / "stl" / "stl024_total.ply")
    low = np.array(OFFSET) - 40
    box = {"ObsMask": np.ones((81, 81, 81), dtype=np.uint8), "BB": np.stack([low, low + 80]), "Res": 1.0}
    savemat(folder / "ObsMask" / "ObsMask24_10.mat", box)
    savemat(folder / "ObsMask" / "Plane24.mat", {"P": np.array([[0.0, 0, 1, 0]])})
    return folder


@pytest.mark.usefixtures("small_disk")
def test_an_evaluation_measures_the_culled_mesh_in_millimetres(scene, tmp_path, monkeypatch):
    monkeypatch.setenv("SPLATWIZARD_DATA", str(tmp_path))
    official(tmp_path / "dtu_gt")
    mesh = with_floater(sphere(60, r=1 + 0.5 / SCALE))  # half a millimetre too large
    monkeypatch.setattr(metrics, "mesh_of", lambda subject: Built(mesh, mesh, {"voxel_size": 0.004}))
    setup = MetricSetup(torch.device("cpu"))
    subject = SimpleNamespace(scene=scene, setup=setup, static={}, keep=None, model=None)
    found = metrics.DTU_CHAMFER(subject)
    assert found.details["protocol"] == dtu.PROTOCOL
    assert found.details["unit"] == "mm"
    assert found.details["cull"] == "all"
    assert found.details["mesh"] == {"voxel_size": 0.004}
    assert found.mean == pytest.approx(0.5, abs=0.1)
    assert metrics.CHAMFER(subject) is None  # DTU's surface is no analytic truth


@pytest.mark.usefixtures("small_disk")
def test_centres_are_another_measure(scene, tmp_path):
    official(tmp_path / "gt")
    settings = {"mesh": {"points": True, "dtu_gt": str(tmp_path / "gt")}}
    means = torch.from_numpy(with_floater(sphere(60)).vertices)
    model = SimpleNamespace(
        device=torch.device("cpu"), gaussians=lambda camera, rasterizer: SimpleNamespace(means=means)
    )
    subject = SimpleNamespace(
        scene=scene, setup=MetricSetup(torch.device("cpu"), settings), static={}, model=model, rasterizer=None
    )
    found = metrics.POINTS(subject)
    assert found.details["protocol"] == dtu.POINTS_PROTOCOL
    assert found.details["d2s"] < 0.3  # the floater is culled


def test_an_unreadable_scan_is_a_reason_not_a_crash(scene, tmp_path):
    official(tmp_path / "gt")
    (tmp_path / "gt" / "ObsMask" / "Plane24.mat").write_bytes(b"nonsense")
    settings = {"mesh": {"dtu_gt": str(tmp_path / "gt")}}
    subject = SimpleNamespace(scene=scene, setup=MetricSetup(torch.device("cpu"), settings), static={}, keep=None)
    with pytest.raises(CapabilityError, match=r"Plane24\.mat: not a MATLAB file"):
        metrics.DTU_CHAMFER(subject)
