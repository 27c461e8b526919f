"""Two closed rules for 16 cameras about a scene, or in it: `orbit16` and `inside16`.

Numbers are rounded to six decimals before they are used, so that every implementation has the same cameras.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from splatwizard_core.api import Camera, GaussianModel, SceneError
from sw_gaussians.made_up_cameras import level_axes

Array = NDArray[np.float64]


def ring_cameras(
    model: GaussianModel, recipe: str, *, size: tuple[int, int] = (1280, 720),
    up: tuple[float, float, float] = (0.0, -1.0, 0.0),
) -> list[Camera]:  # fmt: skip
    """The 16 cameras of `orbit16`, on two rings about the scene, or of `inside16`, in it and looking outwards.

    size    width and height, pixels
    up      world direction

    Numbers are rounded to six decimals. Raises SceneError where no Gaussian is finite, KeyError for another recipe.
    """
    place = RECIPES[recipe]
    center, half = ring_extent(model)
    radius = float(np.linalg.norm(half))
    radius = radius if radius >= 1e-9 else 1.0
    u = np.asarray(up, np.float64)
    u = u / np.linalg.norm(u)
    f, s = level_axes(u)
    found = []
    for j in range(2):
        for k in range(8):
            azimuth = 2 * math.pi * (k + j / 2) / 8
            across = math.cos(azimuth) * f + math.sin(azimuth) * s
            eye, forward, fov = place(center, half, radius, u, across, j)
            found.append(_exact_camera(np.round(eye, 6), forward, u, size, math.radians(fov)))
    return found


def ring_extent(model: GaussianModel) -> tuple[Array, Array]:
    """Centre and half extent [3] of the middle 90 % of the opacity along each axis."""
    points = model.means.detach().double().cpu().numpy()
    weights = torch.sigmoid(model.opacity_logits.detach().double()).cpu().numpy()
    largest = model.log_scales.detach().double().max(dim=1).values.cpu().numpy()
    sound = np.isfinite(points).all(1) & np.isfinite(weights) & np.isfinite(largest)
    if not sound.any():
        raise SceneError("no Gaussian is finite, so there is nothing to look at")
    points, weights, largest = points[sound], weights[sound], largest[sound]
    kept = (weights >= 0.1) & (largest <= np.quantile(largest, 0.999))
    if kept.sum() >= 100:
        points, weights = points[kept], weights[kept]
    low, middle, high = np.stack([_smooth_quantiles(points[:, axis], weights) for axis in range(3)], axis=1)
    return np.round(middle, 6), np.round((high - low) / 2, 6)


def _smooth_quantiles(values: Array, weights: Array) -> Array:
    """Weighted quantiles 5, 50 and 95 %, linear between values."""
    order = np.lexsort((weights, values))
    weights, total = weights[order], float(weights.sum())
    places = (np.cumsum(weights) - weights / 2) / (total or 1.0)
    found: Array = np.interp((0.05, 0.5, 0.95), places, values[order])
    return found


def _orbit(center: Array, half: Array, radius: float, u: Array, across: Array, j: int) -> tuple[Array, Array, float]:
    elevation = math.radians((10, 35)[j])
    direction = math.cos(elevation) * across + math.sin(elevation) * u
    return center + 1.05 * radius / math.sin(math.radians(25)) * direction, -direction, 50


def _within(center: Array, half: Array, radius: float, u: Array, across: Array, j: int) -> tuple[Array, Array, float]:
    level = math.sqrt(float((half**2 * (1 - u**2)).sum()))
    return center + 0.25 * level * across + (-1) ** j * 0.05 * radius * u, across, 75


RECIPES: dict[str, Callable[[Array, Array, float, Array, Array, int], tuple[Array, Array, float]]] = {
    "orbit16": _orbit, "inside16": _within,
}  # fmt: skip
"""Eye, direction of view, and field of view across the shorter side, degrees, of the recipes of `ring_cameras`."""


def _exact_camera(eye: Array, forward: Array, up: Array, size: tuple[int, int], fov: float) -> Camera:
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    rotation = np.round(np.stack([right, np.cross(forward, right), forward]), 6)
    width, height = size
    focal = round(min(size) / (2 * math.tan(fov / 2)), 6)
    R, tau = (torch.from_numpy(each).float() for each in (rotation, np.round(-rotation @ eye, 6)))
    return Camera(width, height, focal, focal, width / 2, height / 2, R, tau)
