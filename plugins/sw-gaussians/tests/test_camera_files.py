"""Files of cameras: what the two forms mean, and what is said of a file that makes no sense."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import pytest
import torch
from sw_gaussians.camera_files import read_cameras

from splatwizard_core.api import Camera, SceneError

CAMERA = Camera.look_at(
    torch.tensor([1.0, 2.0, 3.0]), torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]), width=80, height=60, fov_x=1.0
)


def listed(camera: Camera) -> dict[str, Any]:
    return {
        "id": 0, "img_name": "a", "width": camera.width, "height": camera.height, "fx": camera.fx, "fy": camera.fy,
        "position": camera.center.tolist(), "rotation": camera.R.T.tolist(),
    }  # fmt: skip


def on_a_path(camera: Camera) -> dict[str, Any]:
    to_world = torch.eye(4)
    to_world[:3, :3] = camera.R.T @ torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    to_world[:3, 3] = camera.center
    entry = {"camera_to_world": to_world.flatten().tolist(), "fov": camera.fov_y * 57.29577951, "aspect": 1.33}
    return {"camera_type": "perspective", "render_height": 60, "render_width": 80, "fps": 24, "camera_path": [entry]}


@pytest.mark.parametrize(("content", "fps"), [([listed(CAMERA)], None), (on_a_path(CAMERA), 24)], ids=["list", "path"])
def test_a_camera_is_read_as_it_was(tmp_path: Path, content: Any, fps: float | None):
    (tmp_path / "cameras.json").write_text(json.dumps(content))
    found = read_cameras(tmp_path / "cameras.json")
    assert found.fps == fps
    (camera,) = found.cameras
    torch.testing.assert_close(camera.R, CAMERA.R, atol=1e-5, rtol=0)
    torch.testing.assert_close(camera.tau, CAMERA.tau, atol=1e-5, rtol=0)
    assert (camera.width, camera.height) == (80, 60)
    assert [camera.fx, camera.fy, camera.cx, camera.cy] == pytest.approx([CAMERA.fx, CAMERA.fy, 40, 30], rel=1e-5)


def test_the_principal_point_may_be_told_and_few_digits_do(tmp_path: Path):
    entry = listed(CAMERA) | {
        "cx": 41.5,
        "cy": 29.25,
        "rotation": [[round(x, 3) for x in r] for r in CAMERA.R.T.tolist()],
    }
    (tmp_path / "c.json").write_text(json.dumps([entry, listed(CAMERA)]))
    first, second = read_cameras(tmp_path / "c.json").cameras
    assert (first.cx, first.cy, second.cx) == (41.5, 29.25, 40.0)
    torch.testing.assert_close(first.R @ first.R.T, torch.eye(3), atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda c: [], "0 cameras"),
        (lambda c: {"frames": c}, "neither a list of cameras"),
        (lambda c: [1], "camera 0: not an object"),
        (lambda c: [c[0] | {"width": 0}], "'width' must be a number in 1 .. 16384"),
        (lambda c: [c[0] | {"fx": "80"}], "'fx' must be a number"),
        (lambda c: [c[0] | {"fy": True}], "'fy' must be a number"),
        (lambda c: [c[0] | {"position": [1, 2]}], "'position' must be [3] finite numbers"),
        (lambda c: [c[0] | {"position": [1, 2, float("nan")]}], "'position' must be [3] finite numbers"),
        (lambda c: [c[0] | {"position": [1, 2, {}]}], "'position' must be [3] finite numbers"),
        (lambda c: [c[0], c[0] | {"rotation": [[2, 0, 0], [0, 1, 0], [0, 0, 1]]}], "1: 'rotation' is no rotation"),
        (lambda c: [c[0] | {"rotation": [[-1, 0, 0], [0, 1, 0], [0, 0, 1]]}], "is no rotation"),
        (lambda c: on_a_path(CAMERA) | {"camera_type": "fisheye"}, "type 'fisheye'"),
        (lambda c: on_a_path(CAMERA) | {"render_width": -3}, "'render_width'"),
        (lambda c: on_a_path(CAMERA) | {"fps": 0}, "'fps'"),
    ],
)  # fmt: skip
def test_nonsense_is_told_with_its_place(tmp_path: Path, change: Any, told: str):
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps(change([copy.deepcopy(listed(CAMERA))])))
    with pytest.raises(SceneError) as caught:
        read_cameras(path)
    assert told in str(caught.value)
    assert "cameras.json" in str(caught.value)


def test_what_is_no_json_is_told(tmp_path: Path):
    for content in (b"\x00\xff", b"[" * 100_000, b"{"):
        (tmp_path / "c.json").write_bytes(content)
        with pytest.raises(SceneError, match="not a JSON file of cameras"):
            read_cameras(tmp_path / "c.json")
    with pytest.raises(SceneError, match="cannot be read"):
        read_cameras(tmp_path / "absent.json")
