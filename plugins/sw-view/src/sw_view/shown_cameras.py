"""Cameras for a viewer: those of a scene, or some around a model of which nothing else is known."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from sw_gaussians.made_up_cameras import NEAR, plausible_cameras

from splatwizard_core.api import Camera, GaussianModel, Rasterizer, Scene, SceneError, View
from sw_view.camera_paths import nearest_to_axes

MOST = 64
"""Cameras of a scene that are offered, spread evenly."""
SIZE = (960, 720)
FIELD = math.radians(50)
"""Horizontal field of view of cameras that are made up."""


@dataclass(frozen=True)
class NamedCamera:
    """A camera, what a list calls it, and the test view that it is of, if it is of one."""

    name: str
    camera: Camera
    view: View | None = None


@dataclass(frozen=True)
class Surroundings:
    """Places that a viewer starts from.

    cameras     the first is where it starts
    up          [3] unit length, world
    pivot       [3] what the eye turns around, world
    size        distance of the cameras from the pivot, world units
    """

    cameras: Sequence[NamedCamera]
    up: NDArray[np.float64]
    pivot: NDArray[np.float64]
    size: float


def cameras_of(scene: Scene, most: int = MOST) -> list[NamedCamera]:
    """Return the test cameras, then those of the training that are no test cameras, each evenly spread."""
    tested = {view.name for view in scene.test}
    train = [view for view in scene.train if view.name not in tested]
    kept = [*_evenly(scene.test, most)]
    kept += _evenly(train, most - len(kept))
    return [
        NamedCamera(f"{view.name} (test)", view.camera, view)
        if view.name in tested
        else NamedCamera(f"{view.name} (train)", view.camera)
        for view in kept
    ]


def surroundings_of(scene: Scene) -> Surroundings:
    """Return the places of a scene; the pivot is the point that its cameras look at."""
    cameras = [view.camera for view in (*scene.train, *scene.test)]
    up = np.mean([-camera.R[1].double().cpu().numpy() for camera in cameras], axis=0)
    if np.linalg.norm(up) < 1e-3:  # cameras all around: no direction is up more than another
        up = -cameras[0].R[1].double().cpu().numpy()
    pivot, size = _middle(cameras, scene.extent)
    return Surroundings(cameras_of(scene), up / np.linalg.norm(up), pivot, size)


def _middle(cameras: Sequence[Camera], extent: float) -> tuple[NDArray[np.float64], float]:
    """The point [3] that cameras look at, and their mean distance from it."""
    centers = np.stack([camera.center.double().cpu().numpy() for camera in cameras])
    forwards = np.stack([camera.R[2].double().cpu().numpy() for camera in cameras])
    pivot = looked_at(centers, forwards, extent)
    return pivot, float(np.linalg.norm(centers - pivot, axis=1).mean())


def looked_at(centers: NDArray[np.float64], forwards: NDArray[np.float64], extent: float) -> NDArray[np.float64]:
    """Return the point [3] that is nearest to the optical axes [V,3].

    `extent` ahead where they are parallel or meet in the cameras themselves, which turn at one place: of the first
    camera if they look all around.
    """
    point = nearest_to_axes(centers, forwards)
    if point is not None and ((point - centers) * forwards).sum(axis=1).mean() > 1e-3 * extent:
        return point
    ahead = forwards.mean(axis=0)
    ahead = ahead if np.linalg.norm(ahead) > 0.1 else forwards[0]
    middle: NDArray[np.float64] = centers.mean(axis=0) + extent * ahead / np.linalg.norm(ahead)
    return middle


def made_up_surroundings(model: GaussianModel, rasterizer: Rasterizer) -> Surroundings:
    """Return eight cameras around Gaussians or, in a room, among them; up is -y.

    Raises SceneError where none shows anything.
    """
    made = plausible_cameras(model, rasterizer, fit=6, held_out=2, widest=SIZE[0])
    cameras = [*made.fit, *made.held_out]
    pivot, size = _middle(cameras, cameras[0].near / NEAR)
    named = [NamedCamera(f"made up, {i}", camera) for i, camera in enumerate(cameras, 1)]
    return Surroundings(named, np.array([0.0, -1.0, 0.0]), pivot, size)


def surroundings_about(means: NDArray[np.float32]) -> Surroundings:
    """Return eight cameras around the middle of Gaussians [N,3]; up is -y, as in pictures of COLMAP scenes.

    Raises SceneError where there is none.
    """
    if not len(means):
        raise SceneError("the model has no Gaussian that can be drawn: there is nothing to look at")
    points = means.astype(np.float64)
    pivot = np.median(points, axis=0)
    radius = max(float(np.percentile(np.linalg.norm(points - pivot, axis=1), 80)), 1e-3)
    up = np.array([0.0, -1.0, 0.0])
    distance = 1.6 * radius / math.tan(FIELD / 2)
    cameras = []
    for i in range(8):
        angle = 2 * math.pi * i / 8
        away = np.array([math.sin(angle), -0.35, -math.cos(angle)])
        eye = pivot + distance * away / np.linalg.norm(away)
        camera = Camera.look_at(
            *(torch.from_numpy(v).float() for v in (eye, pivot, up)), width=SIZE[0], height=SIZE[1], fov_x=FIELD
        )
        cameras.append(NamedCamera(f"around, {45 * i} degrees", camera))
    return Surroundings(cameras, up, pivot, distance)


def _evenly(found: Sequence[View], most: int) -> list[View]:
    if len(found) <= most or most < 2:
        return list(found[: max(most, 0)])
    return [found[round(i * (len(found) - 1) / (most - 1))] for i in range(most)]
