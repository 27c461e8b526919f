"""Covariances of Gaussians as numpy arrays or tensors."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def covariances_of(quats: NDArray[Any], scales: NDArray[Any]) -> NDArray[Any]:
    """Return the covariances [N,3,3], world units squared, in the precision of what is given.

    quats       [N,4] w,x,y,z of unit length
    scales      [N,3] standard deviations, world units
    """
    w, x, y, z = quats.T
    rotations = np.stack([
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ], axis=-1).reshape(-1, 3, 3)  # fmt: skip
    axes = rotations * scales[:, None, :]
    covariances: NDArray[Any] = axes @ axes.transpose(0, 2, 1)
    return covariances
