"""Frames of a viewer: the camera of a session, how many pixels are drawn while it moves, and two pictures in one."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from splatwizard_core.api import Camera
from sw_view.path_spline import quat_of, rotation_of

Pixels = NDArray[np.uint8]  # [H,W,3]

BUDGET = 1 / 20
"""Seconds that a frame may take while the camera moves."""
LEAST_SHARE = 0.125
"""Of the side lengths of a frame while the camera moves."""
REST = 0.2
"""Seconds without a movement after which the frame is drawn in full."""
LARGEST_SIDE = 1920


@dataclass
class Pace:
    """Share of the side lengths that is drawn while the camera moves: as many pixels as the budget allows.

    The seconds of a frame are taken as fixed + slope * share^2, by its last two frames of different shares: what is
    spent on Gaussians is fixed, and fewer pixels do not save it. Where it alone is over the budget, the pixels may take
    as long again.
    """

    share: float = 0.5
    fixed: float = 0.0
    _last: tuple[float, float] | None = None

    def drew(self, share: float, seconds: float) -> None:
        """Learn from a frame: its share of the side lengths, and the seconds that it took."""
        area = share * share
        if self._last is not None and abs(area - self._last[0]) > 0.2 * area:
            slope = max(0.0, (seconds - self._last[1]) / (area - self._last[0]))
            self.fixed = max(0.0, seconds - slope * area)
        self._last = (area, seconds)
        slope = max(seconds - self.fixed, 1e-4) / area
        wanted = math.sqrt(max(BUDGET - self.fixed, self.fixed) / slope)
        self.share = min(1.0, max(LEAST_SHARE, 0.5 * self.share + 0.5 * wanted))

    def of(self, still_for: float) -> float:
        """Return the share to draw for a camera that has rested for so many seconds."""
        return 1.0 if still_for >= REST else self.share


def frame_size(width: int, height: int, share: float) -> tuple[int, int]:
    """Return the pixels of a frame for a window: its share, even numbers, no side above `LARGEST_SIDE`."""
    fit = share * min(1.0, LARGEST_SIDE / max(width, height, 1))
    return max(16, round(width * fit / 2) * 2), max(16, round(height * fit / 2) * 2)


def camera_at(wxyz: ArrayLike, position: ArrayLike, fov_y: float, size: tuple[int, int], near: float = 0.2) -> Camera:
    """Return the camera of a session.

    wxyz        [4] camera -> world, OpenCV axes
    position    [3] world units
    fov_y       vertical field of view, radians
    size        width, height in pixels
    """
    rotation = rotation_of(np.asarray(wxyz, np.float64)).T
    width, height = size
    focal = height / (2 * math.tan(fov_y / 2))
    tau = -rotation @ np.asarray(position, np.float64)
    R, t = (torch.from_numpy(value).float() for value in (rotation, tau))
    return Camera(width, height, focal, focal, width / 2, height / 2, R, t, near=near)


def orientation_of(camera: Camera) -> NDArray[np.float64]:
    """Return (w,x,y,z) [4] camera -> world of a camera, unit length."""
    return quat_of(camera.R.double().cpu().numpy().T)


def side_by_side(left: Pixels, right: Pixels, split: float) -> Pixels:
    """Return `left` up to the share `split` of the width, `right` from there, a white line between; all of one size."""
    at = round(split * left.shape[1])
    both = np.concatenate([left[:, :at], right[:, at:]], axis=1)
    if 0 < at < left.shape[1]:
        both[:, max(0, at - 1) : at + 1] = 255
    return both
