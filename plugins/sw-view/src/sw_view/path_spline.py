"""Smooth curves through camera poses: cubic in positions and quaternions, at constant speed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def spline_poses(centers: Array, rotations: Array, frames: int) -> tuple[Array, Array]:
    """Poses on the curve that passes through the given ones, from the first to the last.

    centers     [n,3] world units
    rotations   [n,3,3] world -> camera, proper
    frames      number of poses >= 1

    Returns [frames,3] and [frames,3,3]. A Catmull-Rom spline; its parameter grows with the way and with the turn, so
    that neither a long way nor a quick turn is hurried through.
    """
    if len(centers) == 1:
        return np.repeat(centers, frames, axis=0), np.repeat(rotations, frames, axis=0)
    quats = np.stack([quat_of(each) for each in rotations])
    for i in range(1, len(quats)):  # q and -q turn alike: of the two, the one nearer to the last
        if quats[i] @ quats[i - 1] < 0:
            quats[i] = -quats[i]
    way = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    turn = 2 * np.arccos(np.clip(abs((quats[1:] * quats[:-1]).sum(axis=1)), 0, 1))
    # A half turn counts as much as the whole extent of the cameras.
    pace = way / max(float(np.ptp(centers, axis=0).max()), 1e-12) + turn / np.pi
    knots = np.concatenate([[0.0], np.cumsum(np.maximum(pace, 1e-9))])
    at = np.linspace(0, knots[-1], frames)
    found = _hermite(knots, np.concatenate([centers, quats], axis=1), at)
    return found[:, :3], np.stack([rotation_of(each) for each in found[:, 3:]])


def _hermite(knots: Array, values: Array, at: Array) -> Array:
    """Cubic through values [n,d] at knots [n], tangents from the neighbours, read at [m]; returns [m,d]."""
    slopes = np.gradient(values, knots, axis=0)
    i = np.clip(np.searchsorted(knots, at, side="right") - 1, 0, len(knots) - 2)
    width = (knots[i + 1] - knots[i])[:, None]
    t = ((at - knots[i])[:, None]) / width
    found: Array = (
        (2 * t**3 - 3 * t**2 + 1) * values[i]
        + (t**3 - 2 * t**2 + t) * width * slopes[i]
        + (3 * t**2 - 2 * t**3) * values[i + 1]
        + (t**3 - t**2) * width * slopes[i + 1]
    )
    return found


def quat_of(rotation: Array) -> Array:
    """The unit quaternion (w,x,y,z) of a proper rotation [3,3]."""
    # The eigenvector of the largest eigenvalue: exact also near half turns, where the trace loses digits.
    (a, b, c), (d, e, f), (g, h, i) = rotation
    matrix = np.array([
        [a + e + i, h - f, c - g, d - b],
        [h - f, a - e - i, b + d, c + g],
        [c - g, b + d, e - a - i, f + h],
        [d - b, c + g, f + h, i - a - e],
    ])  # fmt: skip
    quat: Array = np.linalg.eigh(matrix)[1][:, -1]
    return quat if quat[0] >= 0 else -quat


def rotation_of(quat: Array) -> Array:
    """The rotation [3,3] of a quaternion (w,x,y,z) of any norm > 0."""
    w, x, y, z = quat / np.linalg.norm(quat)
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip
