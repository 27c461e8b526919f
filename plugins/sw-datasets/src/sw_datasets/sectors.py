"""Sectors of the cameras about the place that they look at: the split `sector:<deg>`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatwizard_core.api import Camera, SceneError

DEGREES = (10, 180)  # of a sector, smallest and largest
STARTS = range(0, 360, 10)  # degrees: where a sector may start that is not told where to
LEAST_TRAINED = 0.5  # share of the views that such a sector leaves
WORST_CONDITION = 1e6  # of the matrix that gives the focus; beyond it the cameras look in one direction
UPRIGHT = 0.1  # length of the mean of the cameras' up vectors from which on it says where up is
INSTEAD = "use block:<k>of<n>"

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Plan:
    """The plane that cameras turn in: `focus` [3], the point nearest to all optical axes, and two axes [3] in it."""

    focus: Floats
    across: Floats
    along: Floats

    def azimuths(self, centres: Floats) -> Floats:
        """Degrees in 0 .. 360 of points [n,3], to 1e-6."""
        away = centres - self.focus
        degrees = np.degrees(np.arctan2(away @ self.along, away @ self.across))
        return np.round(degrees, 6) % 360


@dataclass(frozen=True)
class Sector:
    """Cameras inside: among those that decide where it lies, and among those that may be tested."""

    start: int
    of_source: list[bool]
    of_tested: list[bool]


def plan_of(cameras: Sequence[Camera]) -> Plan:
    """Find the plane in which cameras stand about a place. Raises SceneError where they all look in one direction."""
    centres, directions, ups = poses_of(cameras)
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    matrix = across.sum(axis=0)
    if not np.linalg.cond(matrix) <= WORST_CONDITION:
        raise SceneError(f"split 'sector': the cameras look in one direction, about no place; {INSTEAD}")
    focus = np.linalg.solve(matrix, (across @ centres[:, :, None]).sum(axis=0)[:, 0])
    behind = int(((focus - centres) * directions).sum(axis=1).__le__(0).sum())
    if 2 * behind > len(cameras):
        raise SceneError(f"split 'sector': {behind} of {len(cameras)} cameras look away from the middle; {INSTEAD}")
    normal = ups.mean(axis=0)
    if np.linalg.norm(normal) < UPRIGHT:
        _, axes = np.linalg.eigh(np.cov((centres - centres.mean(axis=0)).T))
        normal = axes[:, 0] * np.sign(axes[np.abs(axes[:, 0]).argmax(), 0])
    normal = normal / np.linalg.norm(normal)
    flat = (centres - focus) - ((centres - focus) @ normal)[:, None] * normal
    lengths = np.linalg.norm(flat, axis=1)
    first = next((i for i, length in enumerate(lengths) if length >= 1e-9), None)
    if first is None:
        raise SceneError(f"split 'sector': all cameras stand above the place that they look at; {INSTEAD}")
    e1 = flat[first] / lengths[first]
    return Plan(focus, e1, np.cross(normal, e1))


def sector_of(source: Sequence[Camera], tested: Sequence[Camera], degrees: int, start: int | None) -> Sector:
    """Cut a sector of `degrees`, counted from the azimuth of the first camera of `source`, and say who is inside.

    start   where it begins, degrees; None: of all multiples of ten at which something is tested and at least half of
            `source` stays, the one with the median number of views (the lower of two, the smallest start)

    Raises SceneError for a sector out of range, none that fits, and cameras without a middle.
    """
    low, high = DEGREES
    if not low <= degrees <= high or not 0 <= (start or 0) < 360:
        raise SceneError(f"split 'sector': give {low} to {high} degrees, and a start of 0 to 359")
    plan = plan_of(source)
    azimuths, others = (plan.azimuths(poses_of(cameras)[0]) for cameras in (source, tested))

    def inside(where: Floats, first: int) -> NDArray[np.bool_]:
        return np.asarray((where - first) % 360 < degrees)

    if start is None:
        counts = {
            first: held
            for first in STARTS
            if (held := int(inside(azimuths, first).sum())) <= (1 - LEAST_TRAINED) * len(source)
            and held
            and inside(others, first).any()
        }
        if not counts:
            raise SceneError(f"split 'sector:{degrees}': no sector of it leaves half of the views; take a smaller one")
        median = sorted(counts.values())[(len(counts) - 1) // 2]
        start = next(first for first, held in counts.items() if held == median)
    return Sector(start, inside(azimuths, start).tolist(), inside(others, start).tolist())


def poses_of(cameras: Sequence[Camera]) -> tuple[Floats, Floats, Floats]:
    """Centres, viewing directions and up vectors of cameras in the world, [n,3] each."""
    R = np.stack([camera.R.double().numpy() for camera in cameras])  # [n,3,3]
    tau = np.stack([camera.tau.double().numpy() for camera in cameras])
    return -(R.transpose(0, 2, 1) @ tau[:, :, None])[..., 0], R[:, 2], -R[:, 1]
