"""Rotations as three angles: R = Rz(yaw) Ry(pitch) Rx(roll), columns in the order roll, pitch, yaw, radians.

Three numbers instead of the four of a quaternion, whose sign and length are free. Source: MesonGS (arXiv 2409.09756).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

LOCKED = 1e-6
"""Cosine of the pitch below which roll and yaw turn about the same axis: then roll is 0."""

_HALF_PI_HIGH = 1.5707963267341256  # pi / 2 in 33 bits: its product with a small integer is exact
_HALF_PI_LOW = 6.077100506506192e-11  # the rest of it
_SIN = [(-1.0) ** i / math.factorial(2 * i + 1) for i in range(10)]
_COS = [(-1.0) ** i / math.factorial(2 * i) for i in range(10)]


def angles_of(quats: Tensor) -> Tensor:
    """Return the angles [N,3] of quaternions [N,4] (w,x,y,z) of any length; differentiable, also at +-90 degrees pitch.

    pitch in -pi/2 .. pi/2, roll and yaw in -pi .. pi, of the dtype of `quats`. Computed in float64, since near +-90
    degrees the digits of roll and yaw cancel.
    """
    w, x, y, z = torch.nn.functional.normalize(quats.double(), dim=1).unbind(1)
    first, second = 1 - 2 * (y * y + z * z), 2 * (w * z + x * y)  # cos(pitch) times cos and sin of the yaw
    squared = first.square() + second.square()
    locked = squared < LOCKED**2
    # A square root has no gradient at 0, and atan2 none at (0, 0): there, constants take the arguments' place.
    cosine = torch.where(locked, 0.0, squared.masked_fill(locked, 1.0).sqrt())
    # Not by the arcsine, which loses half of the digits near +-90 degrees.
    pitch = torch.atan2(2 * (w * y - x * z), cosine)
    roll = torch.atan2(torch.where(locked, 0.0, 2 * (w * x + y * z)), torch.where(locked, 1.0, 1 - 2 * (x * x + y * y)))
    yaw = torch.atan2(
        torch.where(locked, 2 * (w * z - x * y), second), torch.where(locked, 1 - 2 * (x * x + z * z), first)
    )
    return torch.stack([roll, pitch, yaw], 1).to(quats.dtype)


def quats_of(angles: Tensor) -> Tensor:
    """Return the unit quaternions [N,4] (w,x,y,z) of angles [N,3]; differentiable."""
    half = angles / 2
    return torch.stack(_product(half.cos(), half.sin()), 1)


def exact_quats_of(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return what `quats_of` returns, for float64 [N,3], with +, -, * and rounding alone: the same on every machine.

    |angle| up to 1e5; beyond it sine and cosine lose digits, and above 1e15 they are of no meaning.
    """
    cosines, sines = _cos_sin(angles / 2)
    return np.stack(_product(cosines, sines), 1)


def _product(c: Any, s: Any) -> list[Any]:
    """w, x, y, z of rotations about x, then y, then z, by cosines and sines [N,3] of half angles, arrays or tensors."""
    (cx, cy, cz), (sx, sy, sz) = (c[:, 0], c[:, 1], c[:, 2]), (s[:, 0], s[:, 1], s[:, 2])
    return [
        cz * cy * cx + sz * sy * sx,
        cz * cy * sx - sz * sy * cx,
        cz * sy * cx + sz * cy * sx,
        sz * cy * cx - cz * sy * sx,
    ]


def _cos_sin(x: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Cosine and sine by their power series, after the nearest multiple of pi / 2 is taken off; error under 1e-15."""
    quarter = np.rint(x / (_HALF_PI_HIGH + _HALF_PI_LOW))
    rest = (x - quarter * _HALF_PI_HIGH) - quarter * _HALF_PI_LOW
    square = rest * rest
    cosine, sine = np.full_like(rest, _COS[-1]), np.full_like(rest, _SIN[-1])
    for c, s in zip(_COS[-2::-1], _SIN[-2::-1], strict=True):
        cosine, sine = cosine * square + c, sine * square + s
    sine = sine * rest
    turns = np.mod(quarter, 4)
    odd = (turns == 1) | (turns == 3)
    found_cosine, found_sine = np.where(odd, sine, cosine), np.where(odd, cosine, sine)
    return (
        np.where((turns == 1) | (turns == 2), -found_cosine, found_cosine),
        np.where(turns >= 2, -found_sine, found_sine),
    )
