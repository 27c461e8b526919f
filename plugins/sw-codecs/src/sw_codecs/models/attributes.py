"""Gaussians as a matrix of integers and back: the lattice of the file in mode `quantized`.

Columns: colour band 0 (luma, two chroma), opacity logit, three log scales (of surfels two) in descending order, x, y, z
of the unit quaternion, then three columns for each higher SH coefficient. Dequantising uses +, *, / and square roots of
doubles in a fixed order, so that a file decodes to the same floats on every machine.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatwizard_core.api import UserInputError
from sw_codecs.fast.threads import each_in_turn
from sw_codecs.models import gauge, sh_basis
from sw_codecs.models.luma import to_luma, to_rgb

Array = NDArray[np.float64]

SCALES_FROM = 4
"""First column of the log scales."""
MAX_LOGIT = 20.0
MAX_SYMBOL = 1 << 30

LARGEST_QUAT_STEP = 0.5

ROWS_AT_ONCE = 1 << 13

_PARAMETERS = {"dc": "sh_dc", "opacity": "opacity_logits", "scale": "log_scales", "quat": "quats", "rest": "sh_rest"}
"""Parameter that a step belongs to."""


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


@dataclass(frozen=True)
class Ready:
    """Values, and what their rounding depends on beside the steps.

    factors     of the steps of each row [N]
    basis       for the higher SH coefficients; None: there is none
    """

    values: Values
    factors: Array
    basis: sh_basis.Basis | None = None


def ready(values: Values, factors: Array | None = None, own_basis: bool = False) -> Ready:
    """Make values ready to be rounded.

    factors     [N] of the steps of each Gaussian; None: 1 each
    own_basis   whether higher SH coefficients may get a basis of their own
    """
    count = len(values.opacity_logits)
    factors = np.ones(count) if factors is None else factors
    basis = None
    if own_basis and values.rest.size:
        some = slice(None, None, sh_basis.stride(count))
        basis = sh_basis.fit(_parts(values.rest.reshape(count, -1)[some]), factors[some])
    return Ready(values, factors, basis)


def _parts(rows: NDArray[Any]) -> list[NDArray[Any]]:
    """Some rows at a time."""
    return [rows[start : start + ROWS_AT_ONCE] for start in range(0, max(len(rows), 1), ROWS_AT_ONCE)]


def quantize(given: Ready, steps: Steps, order: NDArray[np.int64]) -> tuple[NDArray[Any], NDArray[np.int8] | None]:
    """Integers [N, 10 + 3R] (of surfels 9 + 3R) of the rows in this order, and the basis of SH where it pays.

    They are int16, or int32 where one needs it, each the nearest one. Raises UserInputError if one is beyond 2^30.

    A dead zone around zero, as in video codecs, does not pay: it shrinks the coefficients of all the Gaussians behind a
    pixel in one direction, so their errors add up (a tenth of a step cost 0.05 dB on the demo scene, and saved less
    than a coarser step that costs as much).
    """
    values, count = given.values, len(order)
    basis = given.basis if given.basis is not None and given.basis.pays(count, steps.rest) else None
    columns = base_columns(values.log_scales.shape[1]) + int(np.prod(values.rest.shape[1:]))
    symbols: NDArray[Any] = np.empty((count, columns), np.int16)  # the largest thing in memory beside the model

    def coded(start: int) -> NDArray[Any]:
        rows = order[start : start + ROWS_AT_ONCE]
        factors = given.factors[rows]
        log_scales, quats = gauge.canonical(values.log_scales[rows], values.quats[rows])
        logits = np.clip(values.opacity_logits[rows].astype(np.float64), -MAX_LOGIT, MAX_LOGIT)[:, None]
        rest = values.rest[rows]
        higher = to_luma(rest) if basis is None else basis.to(rest.reshape(len(rows), -1)).astype(np.float32)
        found = np.hstack([
            _rounded("dc", steps.dc * factors, to_luma(values.dc[rows])),
            _rounded("opacity", steps.opacity * factors, logits),
            _rounded("scale", steps.scale * factors, log_scales),
            _rounded("quat", _quat_steps(steps, factors), quats[:, 1:]),
            _rounded("rest", steps.rest * factors, higher.reshape(len(rows), -1)),
        ])  # fmt: skip
        return found.astype(np.int16 if np.abs(found).max(initial=0) < 1 << 15 else np.int32)

    # Doubles of all rows would outweigh the model several times.
    starts = range(0, count, ROWS_AT_ONCE)
    for start, found in zip(starts, each_in_turn(coded, starts), strict=True):
        if found.dtype != symbols.dtype and symbols.dtype == np.int16:
            symbols = symbols.astype(np.int32)
        symbols[start : start + ROWS_AT_ONCE] = found
    return symbols, None if basis is None else basis.matrix


def _rounded(name: str, steps: Array, values: NDArray[Any]) -> Array:
    """The nearest multiples [N,C] of the step of each row [N]."""
    symbols: Array = values / steps[:, None]
    np.rint(symbols, out=symbols)
    if symbols.size and not -MAX_SYMBOL <= symbols.min() <= symbols.max() <= MAX_SYMBOL:
        raise UserInputError(
            f"a value of '{_PARAMETERS[name]}' is {np.abs(values).max():.3g}, more than 2^30 quantiser steps: "
            f"the model has diverged, or codec.settings.{name}_step is too small"
        )
    return symbols


def _quat_steps(steps: Steps, factors: Array) -> Array:
    """Of each row [N]; a coarser one than 1/2 would leave nothing of a rotation."""
    found: Array = np.minimum(steps.quat * factors, max(steps.quat, LARGEST_QUAT_STEP))
    return found


def dequantize(
    symbols: NDArray[Any], steps: Steps, scales: int = 3, factors: Array | None = None,
    basis: NDArray[np.int8] | None = None,
) -> Values:  # fmt: skip
    """Values, float32, of what `quantize` returns, for Gaussians with so many `scales`."""
    n, quats, columns = len(symbols), SCALES_FROM + scales, base_columns(scales)
    base = symbols[:, :columns].astype(np.float64)
    factors = np.ones(n) if factors is None else factors
    if basis is None:
        rest = symbols[:, columns:].astype(np.float64).reshape(n, -1, 3) * (steps.rest * factors)[:, None, None]
        rest = to_rgb(rest)
    else:
        sums = sh_basis.from_basis(symbols[:, columns:], basis)
        rest = (sums * (steps.rest / sh_basis.UNIT * factors)[:, None]).reshape(n, -1, 3)
    return Values(
        dc=to_rgb(base[:, :3] * (steps.dc * factors)[:, None]).astype(np.float32),
        rest=rest.astype(np.float32),
        opacity_logits=(base[:, 3] * (steps.opacity * factors)).astype(np.float32),
        log_scales=(base[:, SCALES_FROM:quats] * (steps.scale * factors)[:, None]).astype(np.float32),
        quats=gauge.complete(base[:, quats:columns] * _quat_steps(steps, factors)[:, None]).astype(np.float32),
    )
