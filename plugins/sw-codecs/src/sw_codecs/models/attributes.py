"""Gaussians as a matrix of integers and back: the lattice of the file in mode `quantized`.

Columns: colour band 0 (luma, two chroma), opacity logit, three log scales (of surfels two) in descending order, x, y, z
of the unit quaternion, then three columns for each higher SH coefficient. Dequantising uses +, *, / and square roots of
doubles in a fixed order, so that a file decodes to the same floats on every machine.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatwizard_core.api import UserInputError
from sw_codecs.models import gauge

SCALES_FROM = 4
"""First column of the log scales."""
MAX_LOGIT = 20.0
MAX_SYMBOL = 1 << 30

_STEPS = (
    ("sh_dc", "dc"),
    ("opacity_logits", "opacity"),
    ("log_scales", "scale"),
    ("quats", "quat"),
    ("sh_rest", "rest"),
)
"""The parts of a row of integers in order: the parameter it stands for, and its step."""

# Rows of an orthonormal transform of RGB: luma, red-blue, green-magenta. Higher SH coefficients of the three channels
# are strongly correlated in trained scenes; orthonormal, so that one step size means one squared error in all three.
_COLOR = np.array(
    [
        [1 / math.sqrt(3), 1 / math.sqrt(3), 1 / math.sqrt(3)],
        [1 / math.sqrt(2), 0.0, -1 / math.sqrt(2)],
        [1 / math.sqrt(6), -2 / math.sqrt(6), 1 / math.sqrt(6)],
    ]
)


@dataclass(frozen=True)
class Steps:
    """Quantiser steps, each > 0: SH band 0, higher bands, opacity logit, log scale, quaternion component."""

    dc: float
    rest: float
    opacity: float
    scale: float
    quat: float


@dataclass(frozen=True)
class Values:
    """Raw parameters as in GaussianModel, without positions: dc [N,3], rest [N,R,3], logits [N], ..."""

    dc: NDArray[Any]
    rest: NDArray[Any]
    opacity_logits: NDArray[Any]
    log_scales: NDArray[Any]
    quats: NDArray[Any]


def base_columns(scales: int) -> int:
    """Return how many columns stand before those of higher SH coefficients, for Gaussians with so many scales."""
    return SCALES_FROM + scales + 3


def quantize(values: Values, steps: Steps) -> NDArray[np.int32]:
    """Integers [N, 10 + 3R] (of surfels 9 + 3R), each the nearest one. Raises UserInputError if one is beyond 2^30.

    A dead zone around zero, as in video codecs, does not pay: it shrinks the coefficients of all the Gaussians behind a
    pixel in one direction, so their errors add up (a tenth of a step cost 0.05 dB on the demo scene, and saved less
    than a coarser step that costs as much).
    """
    log_scales, quats = gauge.canonical(values.log_scales, values.quats)
    logits = np.clip(np.asarray(values.opacity_logits, np.float64), -MAX_LOGIT, MAX_LOGIT)
    rest = _to_luma(values.rest).reshape(len(logits), 3 * values.rest.shape[1]) / steps.rest
    columns = [
        np.rint(_to_luma(values.dc) / steps.dc),
        np.rint(logits / steps.opacity)[:, None],
        np.rint(log_scales / steps.scale),
        np.rint(quats[:, 1:] / steps.quat),
        np.rint(rest),
    ]
    for (name, step), column in zip(_STEPS, columns, strict=True):
        largest = np.abs(column).max(initial=0.0)
        if not largest <= MAX_SYMBOL:
            raise UserInputError(
                f"a value of '{name}' is {largest * getattr(steps, step):.3g}, more than 2^30 quantiser steps: "
                f"the model has diverged, or codec.settings.{step}_step is too small"
            )
    return np.concatenate(columns, axis=1).astype(np.int32)


def dequantize(symbols: NDArray[Any], steps: Steps, scales: int = 3) -> Values:
    """Inverse of `quantize`, float32, for Gaussians with so many `scales`."""
    n, quats, columns = len(symbols), SCALES_FROM + scales, base_columns(scales)
    base = symbols[:, :columns].astype(np.float64)
    rest = symbols[:, columns:].astype(np.float64).reshape(n, -1, 3)
    return Values(
        dc=_to_rgb(base[:, :3] * steps.dc).astype(np.float32),
        rest=_to_rgb(rest * steps.rest).astype(np.float32),
        opacity_logits=(base[:, 3] * steps.opacity).astype(np.float32),
        log_scales=(base[:, SCALES_FROM:quats] * steps.scale).astype(np.float32),
        quats=gauge.complete(base[:, quats:columns] * steps.quat).astype(np.float32),
    )


def _to_luma(rgb: NDArray[Any]) -> NDArray[np.float64]:
    """[..., 3] red, green, blue -> luma, red-blue, green-magenta."""
    r, g, b = np.moveaxis(np.asarray(rgb, np.float64), -1, 0)
    return np.stack([row[0] * r + row[1] * g + row[2] * b for row in _COLOR], axis=-1)


def _to_rgb(luma: NDArray[np.float64]) -> NDArray[np.float64]:
    """Inverse of `_to_luma`: the transposed matrix."""
    y, u, v = np.moveaxis(luma, -1, 0)
    return np.stack([column[0] * y + column[1] * u + column[2] * v for column in _COLOR.T], axis=-1)
