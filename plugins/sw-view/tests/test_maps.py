"""Maps of surfels against planes that are known exactly, and the colours that maps are shown in."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from sw_reference.rasterizer import ReferenceRasterizer
from sw_view.colors import depth_colors, normal_colors, turbo
from sw_view.drawing import Drawing
from sw_view.map_files import MapFiles
from sw_view.maps import MapRequest, maps_of
from sw_view.modes import AUTO, DEPTHS, RENDERED, SURFACE
from sw_view.views import draw_views

from splatwizard_core.api import Camera, GaussianInputs, RasterOptions, UserInputError, View

DISTANCE = 4.0


def camera_in_the_world() -> Camera:
    """64x48, turned and moved, so that no frame is another by accident."""
    eye, target, up = torch.tensor([1.0, -2, 0.5]), torch.tensor([0.2, 1, 1.0]), torch.tensor([0.0, 0.2, 1])
    return Camera.look_at(eye, target, up, width=64, height=48, fov_x=math.radians(20))


def plane(camera: Camera, tilt: float, *opacities_and_distances: tuple[float, float]) -> GaussianInputs:
    """Surfels that cover the picture, across the camera's axis at a distance, turned about its y axis by a tilt.

    A tilted one reaches no further than to the plane of the camera, where its projection ends.
    """
    half = math.radians(tilt) / 2
    turn = torch.tensor([math.cos(half), 0.0, math.sin(half), 0.0])  # in the camera's frame
    n = len(opacities_and_distances)
    means = torch.stack([camera.center + z * camera.R[2] for _, z in opacities_and_distances])
    opacities, width = torch.tensor([o for o, _ in opacities_and_distances]), 1e4 if tilt == 0 else 1.3
    return GaussianInputs(
        means, opacities, scales=torch.full((n, 2), width),
        quats=(quaternion(camera.R.T) @ turn)[None].repeat(n, 1), colors=torch.rand(n, 3),
    )  # fmt: skip


def quaternion(rotation: torch.Tensor) -> torch.Tensor:
    """[4,4] matrix that multiplies a quaternion (w,x,y,z) by that of a rotation from the left."""
    w = (1 + rotation.trace()).clamp(min=1e-8).sqrt() / 2
    x, y, z = (
        (rotation[2, 1] - rotation[1, 2]) / (4 * w),
        (rotation[0, 2] - rotation[2, 0]) / (4 * w),
        (rotation[1, 0] - rotation[0, 1]) / (4 * w),
    )
    return torch.tensor([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])


class Planes(torch.nn.Module):
    """A model of these inputs, from every camera."""

    def __init__(self, inputs: GaussianInputs, depth_ratio: float | None = None) -> None:
        super().__init__()
        self.inputs = inputs
        if depth_ratio is not None:
            self.surface = SimpleNamespace(depth_ratio=depth_ratio)

    def gaussians(self, _camera: Camera, _rasterizer: object) -> GaussianInputs:
        return self.inputs


def drawing(model: Planes) -> Drawing:
    return Drawing(model, None, ReferenceRasterizer(), RasterOptions(background=torch.zeros(3)), torch.device("cpu"))


def draw(tmp_path, model: Planes, request: MapRequest, **options) -> dict[str, np.ndarray]:
    """kind -> the array of its .npz."""
    camera = camera_in_the_world()
    files = MapFiles(tmp_path, request, **options)
    assert draw_views(drawing(model), [View(camera, "a/one.jpg", lambda: None)], tmp_path, files) == ["a__one.png"]
    found = {}
    for kind, names in files.written.items():
        if "a__one.npz" in names:
            stored = np.load(tmp_path / kind / "a__one.npz")
            found[kind] = stored["normals" if kind == "normals" else "depth"]
    return found


def true_depth(camera: Camera, normal: torch.Tensor) -> torch.Tensor:
    """[H,W] camera z of the plane through the point at DISTANCE on the axis, from its normal in the camera's frame."""
    x = (torch.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (torch.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    return DISTANCE * normal[2] / (normal[0] * x[None] + normal[1] * y[:, None] + normal[2])


@pytest.mark.parametrize("tilt", [0, 45, 65])
def test_a_tilted_plane_has_its_depth_and_its_normal_in_the_world(tmp_path, tilt: float):
    camera = camera_in_the_world()
    model = Planes(plane(camera, tilt, *[(0.99, DISTANCE)] * 3), depth_ratio=1.0)
    angle = math.radians(tilt)
    normal = -torch.tensor([math.sin(angle), 0.0, math.cos(angle)])  # towards the camera, in its frame
    world = (camera.R.T @ normal).numpy()
    for kind in (RENDERED, SURFACE):
        request = MapRequest((SURFACE, "expected", "median"), kind, depth_ratio=drawing(model).depth_ratio)
        found = draw(tmp_path / kind, model, request)
        for mode in request.depths:
            depth = found[f"depth_{mode}"]
            np.testing.assert_allclose(depth, true_depth(camera, normal), rtol=3e-5)
        inside = found["normals"][:, 1:-1, 1:-1]
        error = np.degrees(np.arcsin(np.linalg.norm(np.cross(inside, world, axisa=0, axisc=0), axis=0).clip(0, 1)))
        # Depths are float32: 1e-7 of z between pixels that are 1 / 90 of z apart.
        assert error.max() < (0.01 if kind == RENDERED else 0.1)
        assert (world @ inside.reshape(3, -1) > 0.99).all()


def test_the_surface_blends_expected_and_median_by_the_ratio(tmp_path):
    model = Planes(plane(camera_in_the_world(), 0, (0.6, 2.0), (0.99, 3.0)))
    assert drawing(model).depth_ratio == 0
    expected = (0.6 * 2 + 0.396 * 3) / 0.996
    for ratio, depth in ((0.0, expected), (1.0, 2.0), (0.25, 0.75 * expected + 0.25 * 2)):
        found = draw(tmp_path / str(ratio), model, MapRequest((SURFACE,), depth_ratio=ratio), png=True)
        np.testing.assert_allclose(found["depth_surface"], depth, rtol=2e-5)
        assert f'"depth_ratio": {ratio}' in (tmp_path / str(ratio) / "depth_surface" / "depth.json").read_text()


def test_only_what_is_asked_for_is_drawn():
    base = RasterOptions(antialias=True)
    assert MapRequest().options(base) is base
    assert MapRequest(("inverse",)).options(base).depth == {"inverse"}
    assert MapRequest(normals=SURFACE).options(base).depth == {"expected"}
    assert MapRequest(normals=SURFACE, depth_ratio=1.0).options(base).depth == {"median"}
    assert MapRequest((SURFACE, "inverse"), depth_ratio=0.5).options(base).depth == {"expected", "median", "inverse"}
    both = MapRequest(normals=RENDERED).options(base)
    assert (both.normals, both.alpha, both.antialias, both.depth) == (True, True, True, frozenset())
    assert not MapRequest(alpha=True).options(base).normals


def test_kinds_that_only_surfels_have_are_refused_for_others():
    assert MapRequest(normals=AUTO).suited(surfels=True, what="x").normals == RENDERED
    assert MapRequest(normals=AUTO).suited(surfels=False, what="x").normals == SURFACE
    assert MapRequest(tuple(DEPTHS), RENDERED).suited(surfels=True, what="x") == MapRequest(tuple(DEPTHS), RENDERED)
    for request in (MapRequest(normals=RENDERED), MapRequest((SURFACE,)), MapRequest((SURFACE,), AUTO)):
        with pytest.raises(UserInputError, match="x holds no surfels"):
            request.suited(surfels=False, what="x")


def test_no_normal_is_made_up_beside_a_hole():
    camera = camera_in_the_world()
    result = drawing(Planes(plane(camera, 0, (0.99, DISTANCE)))).render(camera, MapRequest(normals=SURFACE).options(
        RasterOptions()))  # fmt: skip
    result.depth["expected"][0, 20, 30] = math.nan
    lengths = maps_of(result, camera, MapRequest(normals=SURFACE)).normals.norm(dim=0)
    gone = {(20, 30), (19, 30), (21, 30), (20, 29), (20, 31)}
    inside = lengths[1:-1, 1:-1]
    assert {(i + 1, j + 1) for i, j in torch.nonzero(inside == 0).tolist()} == gone


def test_a_wall_that_faces_the_camera_is_blue_and_the_floor_is_green():
    rotation = camera_in_the_world().R.numpy()
    alpha = np.full((1, 4), 0.6, np.float32)
    alpha[0, 3] = 0.4
    towards, up, right = -rotation[2], -rotation[1], rotation[0]
    normals = np.stack([towards, up, right, towards], axis=1)[:, None]
    colors = normal_colors(normals.astype(np.float32), rotation, alpha)[0].astype(int)
    wanted = [(128, 128, 255), (128, 255, 128), (255, 128, 128), (0, 0, 0)]
    assert abs(colors - wanted).max() <= 1  # 127.5 rounds either way


def test_depths_span_the_colours_and_what_is_not_seen_is_black():
    depth = np.linspace(1, 101, 10_000, dtype=np.float32).reshape(100, 100)
    depth[0, 0] = 0
    alpha = np.ones_like(depth)
    alpha[0, 1] = 0.4
    colors = depth_colors(depth, alpha)
    assert not colors[0, :2].any()
    assert tuple(colors[0, 2]) == tuple(turbo(np.array(0.0)))
    assert tuple(colors[-1, -1]) == tuple(turbo(np.array(1.0)))
    assert not depth_colors(np.zeros((2, 2), np.float32), np.ones((2, 2), np.float32)).any()
    flat = depth_colors(np.full((2, 2), 3, np.float32), np.ones((2, 2), np.float32))
    assert (flat == turbo(np.array(0.0))).all()


def test_turbo_is_turbo():
    colormaps = pytest.importorskip("matplotlib").colormaps
    places = np.linspace(0, 1, 256)
    assert abs(turbo(places).astype(int) - 255 * colormaps["turbo"](places)[:, :3]).max() < 3
