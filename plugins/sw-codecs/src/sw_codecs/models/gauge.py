"""One form for each Gaussian: the covariance R S S^T R^T leaves 24 choices of (R, S); a codec should pay for none.

Sorting the axes by size makes the three scale columns narrow; of the four sign choices that are left, the one with
the largest |w| makes w >= 1/2, so that it need not be stored: w = sqrt(1 - x^2 - y^2 - z^2).

A surfel is the case of a third scale of 0: its normal stays the third axis, and 8 choices are left, of which a
renderer, which turns normals to the camera, sees none.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

# Right-multiplication by these unit quaternions permutes the local axes (up to signs, which the covariance does not
# see): column j of the turned frame is column PERMUTATION[i][j] of the old one.
_HALF = np.sqrt(0.5)
PERMUTATIONS = {
    (0, 1, 2): (1.0, 0.0, 0.0, 0.0),
    (1, 2, 0): (0.5, 0.5, 0.5, 0.5),
    (2, 0, 1): (0.5, -0.5, -0.5, -0.5),
    (0, 2, 1): (_HALF, _HALF, 0.0, 0.0),
    (2, 1, 0): (_HALF, 0.0, _HALF, 0.0),
    (1, 0, 2): (_HALF, 0.0, 0.0, _HALF),
}
_HALF_TURNS = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))


def multiply(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Hamilton product of quaternions [...,4] (w,x,y,z)."""
    aw, ax, ay, az = np.moveaxis(a, -1, 0)
    bw, bx, by, bz = np.moveaxis(b, -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def canonical(log_scales: NDArray[Any], quats: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Log scales in descending order and unit quaternions [N,4] with w >= 1/2 of the same covariances.

    log_scales  [N,3], of surfels [N,2]
    quats       [N,4] (w,x,y,z), any norm

    A quaternion of norm 0 becomes the identity.
    """
    width = log_scales.shape[1]
    scales = np.full((len(log_scales), 3), -np.inf)
    scales[:, :width] = log_scales
    q = np.asarray(quats, dtype=np.float64)
    norm = np.linalg.norm(q, axis=1, keepdims=True)
    q = np.where(norm > 1e-12, q / np.maximum(norm, 1e-12), np.array([1.0, 0.0, 0.0, 0.0]))
    order = np.argsort(-scales, axis=1, kind="stable")  # [N,3]
    turn = np.zeros_like(q)
    for permutation, quat in PERMUTATIONS.items():
        turn[(order == permutation).all(axis=1)] = quat
    q = multiply(q, turn)
    candidates = np.stack([multiply(q, np.asarray(half)) for half in _HALF_TURNS])  # [4,N,4]
    best = np.abs(candidates[:, :, 0]).argmax(axis=0)
    q = candidates[best, np.arange(len(q))]
    q = np.where(q[:, :1] < 0, -q, q)
    return np.take_along_axis(scales, order, axis=1)[:, :width], q


def complete(xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit quaternions [N,4] from their x, y, z [N,3]; longer ones than 1 are shortened, w = 0."""
    squared = xyz[:, 0] ** 2 + xyz[:, 1] ** 2 + xyz[:, 2] ** 2
    w = np.sqrt(np.maximum(1.0 - squared, 0.0))
    quats = np.concatenate([w[:, None], xyz], axis=1)
    return quats / np.sqrt(np.maximum(squared, 1.0))[:, None]
