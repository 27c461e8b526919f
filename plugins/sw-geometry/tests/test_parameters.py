"""Parameters that a scene decides, the depth that a model shows, and what is said where Open3D is missing."""

from __future__ import annotations

import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from sw_gaussians.surface import depth_modes
from sw_geometry import check, metrics
from sw_geometry.depth import depth_views
from sw_geometry.fusion import BLOCK_BYTES, EXTRACTION_BYTES, needed_bytes
from sw_geometry.maps import depth_and_normal_error
from sw_geometry.open3d_import import import_open3d, why_not
from sw_geometry.parameters import focus_and_radius, resolve, stated
from sw_geometry.settings import MeshSettings

from splatwizard_core.api import (
    BitstreamError,
    Camera,
    CapabilityError,
    ConfigError,
    MetricSetup,
    Protocol,
    RasterOptions,
    RenderResult,
    Scene,
    SceneError,
    View,
)


def camera(*eye: float, target: tuple[float, float, float] = (1, 2, 3)) -> Camera:
    e, t, up = (torch.tensor(v).double() for v in (eye, target, (0.0, 0, 1)))
    return Camera.look_at(e, t, up, width=32, height=24, fov_x=0.9)


@pytest.fixture
def scene() -> Scene:
    eyes = ((5.0, 2, 3), (1.0, 8, 3), (-2.0, 2, 3))
    views = [View(camera(*eye), f"{i}.png") for i, eye in enumerate(eyes)]
    return Scene("toy", views, views[:1], None, Protocol("colmap", split="all"))


def test_the_focus_is_where_the_axes_meet(scene):
    focus, radius = focus_and_radius([view.camera for view in scene.train])
    assert focus == pytest.approx([1, 2, 3])
    assert radius == pytest.approx(3)


def test_cameras_that_look_one_way_have_no_focus():
    side_by_side = [camera(0, float(i), 0, target=(5, float(i), 0)) for i in range(3)]
    with pytest.raises(SceneError, match="look in one direction: name depth_trunc"):
        focus_and_radius(side_by_side)


def test_a_bounded_scene_decides_by_its_cameras(scene):
    found = resolve(MeshSettings(), scene, {})
    assert found.depth_trunc == pytest.approx(6)
    pixel = 3 / scene.train[0].camera.fx  # 32 px wide: coarser than 6 / 1024
    assert found.voxel_size == pytest.approx(pixel)
    assert resolve(MeshSettings(mesh_res=1024), scene, {}).voxel_size == pytest.approx(6 / 1024)
    fine = replace(scene, train=[replace(v, camera=v.camera.resized(1600, 1200)) for v in scene.train])
    assert resolve(MeshSettings(), fine, {}).voxel_size == pytest.approx(6 / 1024)
    assert found.sdf_trunc == pytest.approx(5 * found.voxel_size)
    assert resolve(MeshSettings(unbounded=True), scene, {}).mesh_res == 256
    assert (found.clusters, found.depth_ratio, found.cull, found.min_views) == (50, 0.0, "none", 1)


def test_dtu_has_its_own_values(scene):
    scene.protocol = Protocol("dtu", split="all")
    found = resolve(MeshSettings(), scene, {})
    assert (found.voxel_size, found.sdf_trunc, found.depth_trunc, found.clusters) == (0.004, 0.016, 3.0, 1)
    assert (found.depth_ratio, found.cull) == (1.0, "all")
    assert resolve(MeshSettings(voxel_size=0.002), scene, {}).sdf_trunc == pytest.approx(0.008)


@pytest.mark.parametrize(
    ("asked", "static", "ratio"),
    [(None, {}, 0), (None, {"depth_ratio": 1}, 1), ("expected", {"depth_ratio": 1}, 0), ("median", {}, 1),
     ("ratio=0.25", {}, 0.25)],
)  # fmt: skip
def test_the_user_then_the_file_decides_the_depth(scene, asked, static, ratio):
    assert resolve(MeshSettings(depth=asked), scene, static).depth_ratio == ratio


def test_a_model_that_was_just_trained_says_its_depth_itself():
    trained = SimpleNamespace(surface=SimpleNamespace(depth_ratio=1.0))
    assert stated(trained, {})["depth_ratio"] == 1
    assert stated(trained, {"depth_ratio": 0.5})["depth_ratio"] == 0.5
    assert stated(SimpleNamespace(surface=None), {}) == stated(object(), {}) == {}


@pytest.mark.parametrize("value", ["1", True, 2, float("nan"), None])
def test_a_file_with_a_senseless_depth_is_refused(scene, value):
    with pytest.raises(BitstreamError, match="depth_ratio"):
        resolve(MeshSettings(), scene, {"depth_ratio": value})


def test_settings_are_checked_by_key_and_value():
    setup = MetricSetup(torch.device("cpu"), {"mesh": {"voxel_size": -1}})
    with pytest.raises(ConfigError, match=r"bad value -1 for 'metrics\.mesh\.voxel_size'"):
        setup.read(MeshSettings, "mesh")
    for wrong in ("nearest", "ratio=2", "ratio="):
        with pytest.raises(ConfigError, match=r"metrics\.mesh\.depth"):
            MetricSetup(torch.device("cpu"), {"mesh": {"depth": wrong}}).read(MeshSettings, "mesh")
    with pytest.raises(ConfigError, match=r"did you mean 'metrics\.mesh\.voxel_size'"):
        MetricSetup(torch.device("cpu"), {"mesh": {"voxelsize": 1}}).read(MeshSettings, "mesh")


def test_memory_that_a_grid_needs():
    assert needed_bytes(100, 0, 2000) == 2000 * BLOCK_BYTES + 100 * EXTRACTION_BYTES
    # 1,900 + 200 do not fit: the room doubles, and for a moment both are there.
    assert needed_bytes(2000, 200, 2000, 1900) == 6000 * BLOCK_BYTES
    assert BLOCK_BYTES == 81_920


class FlatWall:
    """A rasterizer whose every picture is a wall at z = 2 (expected) or 3 (median), half opaque on its left."""

    def render(self, g, cam: Camera, opt: RasterOptions) -> RenderResult:
        full = torch.ones(1, cam.height, cam.width)
        alpha = full.clone()
        alpha[..., : cam.width // 2] = 0.4
        depth = {mode: full * {"expected": 2.0, "median": 3.0}[mode] for mode in opt.depth}
        self.asked = opt
        return RenderResult(0.5 * alpha.repeat(3, 1, 1), torch.ones(1, dtype=torch.int32), g, alpha=alpha, depth=depth)


def model_of(inputs) -> SimpleNamespace:
    return SimpleNamespace(device=torch.device("cpu"), gaussians=lambda camera, rasterizer: inputs)


INPUTS = SimpleNamespace(sh=None)


def test_a_ratio_asks_for_the_depth_that_it_needs():
    assert depth_modes(0) == {"expected"}
    assert depth_modes(1) == {"median"}
    assert depth_modes(0.5) == {"expected", "median"}


def test_depth_is_cut_by_opacity_and_by_masks(scene):
    mask = np.ones((24, 32), dtype=bool)
    mask[:12] = False
    view = replace(scene.train[0], load_mask=lambda: mask)
    wall, options = FlatWall(), RasterOptions(background=torch.ones(3))
    how = {"depth_ratio": 0.5, "alpha_min": 0.5, "mask": True}
    (found,) = depth_views(model_of(INPUTS), [view], wall, options, **how)
    assert wall.asked.background is None
    assert (found.depth[12:, 16:] == 2.5).all()
    assert (found.depth[:12] == 0).all()
    assert (found.depth[:, :16] == 0).all()
    assert found.color == pytest.approx(0.5)  # not darkened where it is half opaque
    (whole,) = depth_views(model_of(INPUTS), [view], wall, options, depth_ratio=0.5, alpha_min=0.3, mask=False)
    assert (whole.depth == 2.5).all()
    assert found.E[:3, 3] == pytest.approx(view.camera.tau.numpy())


def test_errors_of_depth_and_normals_on_a_wall(scene):
    view = scene.train[0]
    exact = torch.full((1, 24, 32), 2.5)
    exact[..., -4:] = 0  # nothing there: not compared
    facing = -view.camera.R[2].float()  # towards the camera: the wall's normal
    turned = torch.linalg.cross(facing, torch.tensor([0.0, 0, 1]))
    tilted = np.cos(0.3) * facing + np.sin(0.3) * turned / turned.norm()
    truth = {"depth": {"0.png": exact}, "normal_maps": {"0.png": tilted[:, None, None].expand(3, 24, 32)}}
    found = depth_and_normal_error(
        model_of(INPUTS), [view], FlatWall(), RasterOptions(), truth, depth_ratio=0.0, alpha_min=0.5
    )
    assert found["depth"]["abs_rel"] == pytest.approx(0.2)
    assert found["depth"]["rmse"] == pytest.approx(0.5)
    assert found["depth"]["covered"] == pytest.approx(12 / 28)
    inner = found["normals"]
    assert inner["median"] == pytest.approx(np.degrees(0.3), abs=1e-3)
    assert inner["within_11"] < 0.1 < 0.9 < inner["within_22"]  # 17.2 degrees, but beside the step
    nothing = {"depth": {"0.png": torch.zeros(1, 24, 32)}}
    assert not depth_and_normal_error(
        model_of(INPUTS), [view], FlatWall(), RasterOptions(), nothing, depth_ratio=0.0, alpha_min=0.5
    )


@pytest.fixture
def no_open3d(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    import_open3d.cache_clear()
    yield
    import_open3d.cache_clear()


@pytest.mark.usefixtures("no_open3d")
def test_a_missing_open3d_is_named_with_its_package():
    with pytest.raises(CapabilityError, match=r"meshes need Open3D: pip install 'sw-geometry\[mesh\]'"):
        import_open3d()
    (found,) = check.check_open3d()
    assert (found.state, found.mend) == ("missing", "pip install 'sw-geometry[mesh]'")
    told = metrics.CHAMFER.unavailable(MetricSetup(torch.device("cpu")))
    assert "pip install" in told
    assert metrics.DEPTH.unavailable(MetricSetup(torch.device("cpu"))) is None


def test_a_missing_library_of_the_system_is_named_with_debians_packages():
    told = why_not(ImportError("libusb-1.0.so.0: cannot open shared object file: No such file or directory"))
    assert "libusb-1.0.so.0" in told
    assert "apt install libgl1 libegl1 libx11-6 libgomp1 libusb-1.0-0" in told
    assert "\n" not in told
    other = why_not(ImportError("numpy.core.multiarray failed\nto import"))
    assert "numpy.core.multiarray failed to import" in other
    assert "force-reinstall" in other


@pytest.mark.usefixtures("no_open3d")
def test_a_scene_without_truth_has_no_chamfer_distance_and_one_with_it_has_a_reason(scene):
    subject = SimpleNamespace(scene=scene, setup=MetricSetup(torch.device("cpu")), static={}, keep=None)
    for metric in (
        metrics.CHAMFER,
        metrics.F_SCORE,
        metrics.DTU_CHAMFER,
        metrics.DEPTH,
        metrics.NORMALS,
        metrics.POINTS,
    ):
        assert metric(subject) is None
    scene.ground_truth["points"] = torch.rand(5, 3)
    fresh = SimpleNamespace(scene=scene, setup=MetricSetup(torch.device("cpu")), static={}, keep=None)
    fresh.model, fresh.rasterizer, fresh.options = model_of(INPUTS), FlatWall(), RasterOptions()
    with pytest.raises(CapabilityError, match="package-missing"):
        metrics.CHAMFER(fresh)


def test_a_dtu_scan_without_official_files_has_that_reason(scene, tmp_path):
    scene.protocol, scene.path = Protocol("dtu", split="all"), str(tmp_path / "scan24")
    settings = {"mesh": {"dtu_gt": str(tmp_path)}}
    subject = SimpleNamespace(scene=scene, setup=MetricSetup(torch.device("cpu"), settings), static={}, keep=None)
    with pytest.raises(CapabilityError, match=r"^dtu-gt-missing: "):
        metrics.DTU_CHAMFER(subject)
