"""Cameras in the comments of a .ply: written, read, and what is refused with its line."""

from __future__ import annotations

from pathlib import Path

import pytest
from sw_interchange.ply_cameras import PlyCamera, ply_camera_comments, read_ply_cameras

from splatwizard_core.api import UserInputError

CAMERAS = [
    PlyCamera(1, 1, (0.5, -2.0, 3.25), (1.0, 0.0, 0.0, 0.0), 900.0, 901.5, "front left.png"),
    PlyCamera(2, 1, (0.0, 0.0, 0.0), (0.6, 0.8, 0.0, 0.0), 900.0, 901.5, "Front left.png"),
]
NAMES = "camera_position_header imageId cameraId px py pz qw qx qy qz fx fy name"


def ply(folder: Path, comments: list[str], end: str = "\n") -> Path:
    path = folder / "model.ply"
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {c}" for c in comments),
        "element vertex 0",
        "end_header",
    ]
    path.write_bytes(end.join([*lines, ""]).encode())
    return path


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_what_is_written_is_read_and_written_alike(tmp_path: Path, end: str):
    comments = ply_camera_comments(CAMERAS)
    found = read_ply_cameras(ply(tmp_path, comments, end))
    assert found == CAMERAS
    assert ply_camera_comments(found) == comments


def test_a_quaternion_is_made_a_unit_one(tmp_path: Path):
    (found,) = read_ply_cameras(ply(tmp_path, [NAMES, "camera_position 1 1 0 0 0 0 0 3 4 10 10 a"]))
    assert found.quat == pytest.approx((0, 0, 0.6, 0.8))


def test_a_file_without_them_has_none(tmp_path: Path):
    assert read_ply_cameras(ply(tmp_path, ["made by somebody"])) == []
    (tmp_path / "other.spz").write_bytes(b"\x1f\x8b" + bytes(50))
    assert read_ply_cameras(tmp_path / "other.spz") == []


@pytest.mark.parametrize(("comments", "told"), [
    ([NAMES, "camera_position 1 1 0 0 0 1 0 0 0 10 10"], "line 4: camera_position has 11 columns"),
    ([NAMES.removesuffix(" name")], "line 3: camera_position_header has 11 columns"),
    ([NAMES + " more"], "has 13 columns"),
    (["camera_position 1 1 0 0 0 1 0 0 0 10 10 a"], "stands before"),
    ([NAMES, "camera_position 1 1 nan 0 0 1 0 0 0 10 10 a"], "not finite"),
    ([NAMES, "camera_position 1 1 0 0 0 0 0 0 1e-9 10 10 a"], "the quaternion is 0"),
    ([NAMES, "camera_position 1 1 0 0 0 1 0 0 0 -1 10 a"], "must be above 0"),
    ([NAMES, "camera_position 1 x 0 0 0 1 0 0 0 1 10 a"], "must have two whole numbers"),
    ([NAMES, *["camera_position 7 1 0 0 0 1 0 0 0 1 10 a b"] * 2], "two cameras of image 7, 'a b'"),
])  # fmt: skip
def test_what_makes_no_sense_is_refused(tmp_path: Path, comments: list[str], told: str):
    with pytest.raises(UserInputError, match=told):
        read_ply_cameras(ply(tmp_path, comments))
