"""Cameras of a video: a path made from those of a scene, or the ones of a file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from sw_gaussians.camera_files import read_cameras

from splatwizard_core.api import Camera, SceneError, UserInputError, View
from sw_view.camera_paths import along, orbit, seen_depths, spiral
from sw_view.modes import PATHS

if TYPE_CHECKING:
    from sw_view.drawing import Drawing

FRAMES, FPS = 120, 30.0
"""Of a path that is made here, unless told otherwise: four seconds."""


@dataclass(frozen=True)
class Trajectory:
    """Cameras to be drawn one after the other, all of one size, and the frames per second that they are meant for."""

    cameras: list[Camera]
    fps: float

    @property
    def views(self) -> list[View]:
        """The cameras as views without pictures, frame_0000 and on."""
        return [View(camera, f"frame_{i:04d}") for i, camera in enumerate(self.cameras)]


def make_trajectory(
    drawing: Drawing, kind: str, *, frames: int | None, fps: float | None, size: tuple[int, int] | None,
    fit: Callable[[tuple[int, int]], tuple[int, int]] | None = None,
) -> Trajectory:  # fmt: skip
    """Return the cameras of a path.

    kind    a name of `modes.PATHS`, which goes by the scene's training cameras, or a file of cameras
    frames  number of cameras; None: FRAMES. A file has its own
    fps     None: that of the file, else FPS
    size    width, height, pixels; None: that of the first camera. The vertical field of view is kept
    fit     what else the size must be; None: any will do

    Raises UserInputError, SceneError.
    """
    found = read_cameras(kind) if kind not in PATHS else None
    cameras = [view.camera for view in drawing.scene.train] if found is None else found.cameras
    if not cameras:
        raise SceneError(f"scene {drawing.scene.name} has no training cameras for a path")
    size = size or (cameras[0].width, cameras[0].height)
    size = size if fit is None else fit(size)
    if found is not None:
        if frames is not None:
            raise UserInputError(f"--frames is for {', '.join(PATHS)}: {kind} has a camera for every frame")
        return Trajectory([resized(camera, size) for camera in cameras], fps or found.fps or FPS)
    frames, fps = frames or FRAMES, fps or FPS
    if kind == "cameras":
        return Trajectory(along(cameras, frames, size), fps)
    depths = seen_depths(drawing.model, cameras, drawing.rasterizer)
    return Trajectory({"orbit": orbit, "spiral": spiral}[kind](cameras, frames, size, depths), fps)


def resized(camera: Camera, size: tuple[int, int]) -> Camera:
    """The camera with a picture of another size: the same vertical field of view, what is beside it cut or added."""
    width, height = size
    by = height / camera.height
    return replace(
        camera, width=width, height=height, fx=camera.fx * by, fy=camera.fy * by,
        cx=width / 2 + (camera.cx - camera.width / 2) * by, cy=camera.cy * by,
    )  # fmt: skip


def even(size: tuple[int, int]) -> tuple[int, int]:
    """The size with odd numbers made even: of two by two pixels a video keeps one colour."""
    return size[0] - size[0] % 2, size[1] - size[1] % 2
