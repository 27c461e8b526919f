"""Cameras in the header of a .ply, as the MPEG exploration of Gaussian splat coding (2025) keeps them in comments.

A line `comment camera_position_header` with twelve names of columns, then a line `comment camera_position` for each:
imageId cameraId px py pz qw qx qy qz fx fy name. p is the camera's centre in world units, the quaternion has its scalar
first, f is in pixels; the picture's size is not there. Source: specification of the protocols, cameras in the .ply.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from splatwizard_core.api import UserInputError

HEADER, ROW = "camera_position_header", "camera_position"
COLUMNS = ("imageId", "cameraId", "px", "py", "pz", "qw", "qx", "qy", "qz", "fx", "fy", "name")
LONGEST_HEADER = 16 << 20  # bytes
SMALLEST_QUATERNION = 1e-8


@dataclass(frozen=True)
class PlyCamera:
    """One row: ids, centre in the world, unit quaternion (w, x, y, z), focal lengths in pixels, name."""

    image: int
    camera: int
    center: tuple[float, float, float]
    quat: tuple[float, float, float, float]
    fx: float
    fy: float
    name: str


def read_ply_cameras(path: Path) -> list[PlyCamera]:
    """Read the cameras of a .ply's comments; empty without any. Raises UserInputError that names the line."""
    found: list[PlyCamera] = []
    named = False
    for number, line in enumerate(_header(path), 1):
        words = line.split(maxsplit=2)
        if words[:1] != ["comment"] or len(words) < 2:
            continue
        text = words[2] if len(words) > 2 else ""
        place = f"{path.name}, line {number}"
        if words[1] == HEADER:
            if len(text.split()) != len(COLUMNS):
                raise UserInputError(f"{place}: {HEADER} has {len(text.split())} columns; it must have {len(COLUMNS)}")
            named = True
        elif words[1] == ROW:
            if not named:
                raise UserInputError(f"{place}: {ROW} stands before {HEADER}")
            found.append(_row(text, place))
    seen: set[tuple[int, str]] = set()
    for each in found:
        if (each.image, each.name) in seen:
            raise UserInputError(f"{path.name}: two cameras of image {each.image}, '{each.name}'")
        seen.add((each.image, each.name))
    return found


def ply_camera_comments(cameras: Sequence[PlyCamera]) -> list[str]:
    """The comments, without the word `comment`, that `read_ply_cameras` reads; ten decimals."""
    if not cameras:
        return []
    lines = [f"{HEADER} {' '.join(COLUMNS)}"]
    for each in cameras:
        numbers = " ".join(f"{value:.10f}" for value in (*each.center, *each.quat, each.fx, each.fy))
        lines.append(f"{ROW} {each.image} {each.camera} {numbers} {each.name}")
    return lines


def _row(text: str, place: str) -> PlyCamera:
    words = text.split(maxsplit=len(COLUMNS) - 1)  # the name is last, and may hold spaces
    if len(words) != len(COLUMNS):
        raise UserInputError(f"{place}: {ROW} has {len(words)} columns; it must have {len(COLUMNS)}")
    try:
        image, camera = int(words[0]), int(words[1])
        numbers = [float(word) for word in words[2:11]]
    except ValueError:
        raise UserInputError(f"{place}: {ROW} must have two whole numbers, nine numbers and a name") from None
    if not all(math.isfinite(value) for value in numbers):
        raise UserInputError(f"{place}: {ROW} has a number that is not finite")
    px, py, pz, qw, qx, qy, qz, fx, fy = numbers
    length = math.hypot(qw, qx, qy, qz)
    if length < SMALLEST_QUATERNION:
        raise UserInputError(f"{place}: the quaternion is 0")
    if fx <= 0 or fy <= 0:
        raise UserInputError(f"{place}: the focal lengths {fx:g}, {fy:g} must be above 0")
    quat = (qw / length, qx / length, qy / length, qz / length)
    return PlyCamera(image, camera, (px, py, pz), quat, fx, fy, words[11].rstrip())


def _header(path: Path) -> list[str]:
    """Lines of the header of a .ply, up to `end_header`; of another file none."""
    try:
        with path.open("rb") as file:
            if file.readline(16).rstrip(b"\r\n") != b"ply":
                return []
            lines = ["ply"]
            left = LONGEST_HEADER
            while left > 0 and (line := file.readline(left)):
                left -= len(line)
                lines.append(line.decode("utf-8", errors="replace").rstrip("\r\n"))
                if lines[-1] == "end_header":
                    break
            return lines
    except OSError as error:
        raise UserInputError(f"{path}: cannot be read: {error.strerror}") from error
