"""Camera paths for videos and comparisons: an orbit, a spiral, a spline through given cameras.

All cameras of a path share one picture size and one field of view, the median vertical one of the cameras given.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from splatwizard_core.api import Camera, SceneError
from sw_view.path_spline import spline_poses

if TYPE_CHECKING:
    from splatwizard_core.api import Rasterizer, SplatModel

Array = NDArray[np.float64]

SPIRAL_TURNS = 2
"""Turns of a spiral, during which it moves forward and back once, so that the video loops."""
NEARLY_PARALLEL = 1e-3
"""Mean squared sine of the angles between viewing directions below which they count as parallel (2 degrees)."""


def orbit(cameras: Sequence[Camera], frames: int, size: tuple[int, int], depths: tuple[float, float]) -> list[Camera]:
    """Circle once around what the cameras look at, at their median height and distance, beginning near the first.

    frames  number of cameras >= 1; the one after the last would be the first
    size    width, height of a picture, pixels
    depths  near and far of what is seen, world units: where they look if their directions are parallel

    Raises SceneError if the cameras look away from each other, or have no common axis to circle about.
    """
    centers, rotations = _poses(cameras)
    target = focus_of(cameras, math.sqrt(depths[0] * depths[1]))
    if np.median(np.einsum("ni,ni->n", target - centers, rotations[:, 2])) <= 0:
        raise SceneError("the cameras look away from each other, so there is nothing to orbit: take 'cameras'")
    up = _unit((-rotations[:, 1]).mean(axis=0))
    offsets = centers - target
    heights = offsets @ up
    across = offsets - heights[:, None] * up
    distances = np.linalg.norm(across, axis=1)
    radius, height = float(np.median(distances)), float(np.median(heights))
    if radius <= 1e-3 * float(np.linalg.norm(offsets, axis=1).max()):
        raise SceneError("the cameras look straight down or up, so an orbit has no axis: take 'cameras' or 'spiral'")
    first = across[int((distances > 0.5 * radius).argmax())]
    x = _unit(first)
    y = np.cross(up, x)
    found = []
    for angle in 2 * math.pi * np.arange(frames) / frames:
        eye = target + height * up + radius * (math.cos(angle) * x + math.sin(angle) * y)
        found.append(_looking(cameras, eye, target, up, size))
    return found


def spiral(cameras: Sequence[Camera], frames: int, size: tuple[int, int], depths: tuple[float, float]) -> list[Camera]:
    """Wind about the mean camera of a forward-facing scene, looking at one point; arguments as of `orbit`.

    Radii are the 90th percentiles of the cameras' offsets; the point lies at the depth whose reciprocal is a quarter of
    that of near and three quarters of that of far.
    Source: Local Light Field Fusion (arXiv 1905.00889), NeRF (arXiv 2003.08934).
    """
    centers, rotations = _poses(cameras)
    near, far = depths
    distance = 1 / (0.25 / near + 0.75 / far)
    middle, forward = centers.mean(axis=0), _unit(rotations[:, 2].mean(axis=0))
    up = _unit((-rotations[:, 1]).mean(axis=0))
    right = _unit(np.cross(forward, up))
    axes = np.stack([right, np.cross(forward, right), forward])
    radii = np.percentile(abs((centers - middle) @ axes.T), 90, axis=0)
    if radii.max() <= 1e-6 * distance:  # one camera: a path that shows some parallax
        radii = np.array([0.05, 0.05, 0.0]) * distance
    target = middle + distance * forward
    found = []
    for angle in 2 * math.pi * SPIRAL_TURNS * np.arange(frames) / frames:
        offset = np.array([math.cos(angle), math.sin(angle), math.sin(angle / SPIRAL_TURNS)]) * radii
        found.append(_looking(cameras, middle + offset @ axes, target, up, size))
    return found


def along(cameras: Sequence[Camera], frames: int, size: tuple[int, int]) -> list[Camera]:
    """Fly through the cameras on a smooth curve at an even pace, from the first to the last; arguments as of `orbit`.

    Where the cameras outnumber a third of the frames, evenly chosen ones are passed, else the path would jitter.
    They are taken in their order, or from each to its nearest where that path is less than half as long.
    """
    centers, rotations = _poses(cameras)
    order = _order(centers)
    keys = order[np.linspace(0, len(order) - 1, min(len(order), max(2, frames // 3))).round().astype(int)]
    eyes, turned = spline_poses(centers[keys], rotations[keys], frames)
    return [_camera(cameras, eye, rotation, size) for eye, rotation in zip(eyes, turned, strict=True)]


def focus_of(cameras: Sequence[Camera], depth: float) -> Array:
    """Return the point [3] nearest to all viewing axes; if parallel, `depth` in front of the mean camera."""
    centers, rotations = _poses(cameras)
    forward = rotations[:, 2]
    point = nearest_to_axes(centers, forward)
    return centers.mean(axis=0) + depth * _unit(forward.mean(axis=0)) if point is None else point


def nearest_to_axes(centers: Array, forwards: Array) -> Array | None:
    """Return the point [3] nearest to the viewing axes from `centers` [n,3] along unit `forwards` [n,3].

    None where they are nearly parallel.
    """
    across = np.eye(3) - forwards[:, :, None] * forwards[:, None, :]  # [n,3,3] onto the plane across each axis
    mean = across.mean(axis=0)
    if np.linalg.eigvalsh(mean)[0] < NEARLY_PARALLEL:
        return None
    point: Array = np.linalg.solve(mean, np.einsum("nij,nj->i", across, centers) / len(centers))
    return point


def seen_depths(model: SplatModel, cameras: Sequence[Camera], rasterizer: Rasterizer) -> tuple[float, float]:
    """Return the 5th and 95th percentile of camera depth over visible Gaussians, world units, from a few cameras.

    Only those of opacity 0.1 and more count. Raises SceneError if none is in any picture.
    """
    chosen = [cameras[i] for i in np.linspace(0, len(cameras) - 1, min(len(cameras), 8)).round().astype(int)]
    found = []
    with torch.no_grad():
        for camera in (each.to(model.device) for each in chosen):
            inputs = model.gaussians(camera, rasterizer)
            x, y, z = (inputs.means @ camera.R.T + camera.tau).unbind(1)
            tx, ty = camera.tan_half_fov
            inside = (z > camera.near) & (x.abs() < tx * z) & (y.abs() < ty * z) & (inputs.opacities >= 0.1)
            found.append(z[inside].cpu().double().numpy())
    depths = np.concatenate(found)
    if not len(depths):
        raise SceneError("no Gaussian of opacity 0.1 or more is seen by the cameras")
    near, far = np.percentile(depths, [5, 95])
    return float(near), float(far)


def _poses(cameras: Sequence[Camera]) -> tuple[Array, Array]:
    """Centres [n,3] and rotations from world to camera [n,3,3]."""
    rotations = np.stack([each.R.detach().cpu().double().numpy() for each in cameras])
    translations = np.stack([each.tau.detach().cpu().double().numpy() for each in cameras])
    return -np.einsum("nji,nj->ni", rotations, translations), rotations


def _order(centers: Array) -> NDArray[np.intp]:
    """Return camera indices in path order."""
    given = np.arange(len(centers))
    left, path = np.ones(len(centers), dtype=bool), [0]
    left[0] = False
    while left.any():
        path.append(int(np.where(left, np.linalg.norm(centers - centers[path[-1]], axis=1), np.inf).argmin()))
        left[path[-1]] = False
    nearest = np.array(path)

    def length(order: NDArray[np.intp]) -> float:
        return float(np.linalg.norm(np.diff(centers[order], axis=0), axis=1).sum())

    return nearest if length(nearest) < 0.5 * length(given) else given


def _looking(cameras: Sequence[Camera], eye: Array, target: Array, up: Array, size: tuple[int, int]) -> Camera:
    forward = _unit(target - eye)
    right = _unit(np.cross(forward, up))
    return _camera(cameras, eye, np.stack([right, np.cross(forward, right), forward]), size)


def _camera(cameras: Sequence[Camera], eye: Array, rotation: Array, size: tuple[int, int]) -> Camera:
    width, height = size
    focal = height / (2 * float(np.median([each.tan_half_fov[1] for each in cameras])))
    R = torch.from_numpy(np.ascontiguousarray(rotation)).float()
    tau = torch.from_numpy(-rotation @ eye).float()
    near = min(each.near for each in cameras)
    return Camera(width, height, focal, focal, width / 2, height / 2, R, tau, near=near)


def _unit(vector: Array) -> Array:
    length = float(np.linalg.norm(vector))
    if length < 1e-9:
        raise SceneError("the cameras look in all directions, so they have no common axis: take 'cameras'")
    unit: Array = vector / length
    return unit
