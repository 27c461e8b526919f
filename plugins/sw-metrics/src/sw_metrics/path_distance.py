"""Path distance: how far each test view lies from the training views, whatever the model shows.

A split whose test views lie between trained ones (every8) asks for interpolation, one that holds out a sector for
extrapolation; these numbers say which it was, view by view. Source: specification of the protocols, path distance.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from splatwizard_core.api import Camera, MetricResult, Subject

Floats = NDArray[np.float64]


def path_distance(subject: Subject) -> MetricResult:
    """Distance to the nearest training camera, in medians of the distance from one training camera to its nearest."""
    centres, _ = poses([view.camera for view in subject.scene.test])
    trained, _ = poses([view.camera for view in subject.scene.train])
    among = pairwise(trained, trained)
    np.fill_diagonal(among, np.inf)
    spacing = float(np.median(among.min(axis=1))) if len(trained) > 1 else 0.0
    if spacing == 0:
        return unknown(len(centres), "training cameras have no distance from each other")
    return summary(pairwise(centres, trained).min(axis=1) / spacing)


def path_angle(subject: Subject) -> MetricResult:
    """Angle between the viewing direction and that of the training view which looks most alike, degrees."""
    _, directions = poses([view.camera for view in subject.scene.test])
    _, trained = poses([view.camera for view in subject.scene.train])
    return summary(angles(directions, trained).min(axis=1))


def path_combined(subject: Subject) -> MetricResult:
    """Least sum of distance / scene extent (1.1 times the radius of the training cameras) and angle / 90 degrees."""
    centres, directions = poses([view.camera for view in subject.scene.test])
    trained, looking = poses([view.camera for view in subject.scene.train])
    extent = 1.1 * float(np.linalg.norm(trained - trained.mean(axis=0), axis=1).max())
    if extent == 0:
        return unknown(len(centres), "all training cameras stand at one place")
    return summary((pairwise(centres, trained) / extent + angles(directions, looking) / 90).min(axis=1))


def poses(cameras: Sequence[Camera]) -> tuple[Floats, Floats]:
    """Centres and unit viewing directions in the world, [n,3] each."""
    R = np.stack([camera.R.double().cpu().numpy() for camera in cameras])  # [n,3,3]
    tau = np.stack([camera.tau.double().cpu().numpy() for camera in cameras])
    directions = R[:, 2] / np.linalg.norm(R[:, 2], axis=1, keepdims=True)
    return -(R.transpose(0, 2, 1) @ tau[:, :, None])[..., 0], directions


def pairwise(a: Floats, b: Floats) -> Floats:
    """[n,m] distances of points [n,3] from points [m,3]."""
    return np.asarray(np.linalg.norm(a[:, None] - b[None], axis=2))


def angles(a: Floats, b: Floats) -> Floats:
    """[n,m] degrees between unit vectors [n,3] and [m,3]; exact also where they are nearly equal."""
    return np.degrees(2 * np.arctan2(pairwise(a, b), np.linalg.norm(a[:, None] + b[None], axis=2)))


def summary(values: Floats) -> MetricResult:
    """The values per view, and their mean."""
    return MetricResult(float(values.mean()), values.tolist(), "lower")


def unknown(count: int, reason: str) -> MetricResult:
    """No value for any view, and why."""
    return MetricResult(None, [None] * count, "lower", reason)
