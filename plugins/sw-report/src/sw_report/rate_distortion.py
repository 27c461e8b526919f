"""BD-rate and BD-PSNR: the mean distance between two rate-distortion curves, as one number.

A curve is a few files of one method on one scene: their bytes and their quality. Rates are compared as
r = log10(bytes), so that a saving of half counts the same everywhere.
Source: Bjontegaard, VCEG-M33 (2001); with PCHIP as in JCTVC-L1100 (2013).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from splatwizard_core.api import UserInputError

Floats = NDArray[np.float64]
Method = Literal["pchip", "cubic"]

FEWEST_POINTS = 4  # with fewer, a cubic through the points says more about itself than about the method
LOW_OVERLAP = 0.25  # of either curve's range


@dataclass(frozen=True)
class BdResult:
    """Mean distance of one curve from another.

    value       percent (BD-rate; negative: the test curve saves rate) or units of quality (BD-PSNR; positive: better);
                None where the curves share no range
    overlap     shared range as a share of the wider curve's range, 0..1
    flags       "low_overlap": under 25 % of either range; "no_overlap"; "few_points": fewer than 4 points, straight
                lines between them
    """

    value: float | None
    overlap: float
    flags: tuple[str, ...] = ()


class _Curve(Protocol):
    def integral(self, low: float, high: float) -> float: ...


def bd_rate(
    anchor: tuple[Sequence[float], Sequence[float]],
    test: tuple[Sequence[float], Sequence[float]],
    *,
    method: Method = "pchip",
    pareto: bool = False,
    names: tuple[str, str] = ("anchor", "test"),
    metric: str = "quality",
) -> BdResult:
    """Mean additional rate, in percent, that `test` takes against `anchor` for the same quality.

    anchor, test    (bytes, quality) of the points, in any order; quality is higher for better (PSNR, SSIM, -LPIPS)
    method          "pchip": monotone piecewise cubic; "cubic": one polynomial, for exactly 4 points a curve
    pareto          first drop points that a smaller file equals or beats
    names           what messages call the two curves
    metric          what messages call the quality

    r is interpolated as a function of quality over the qualities that both curves reach; the mean difference d gives
    (10^d - 1) x 100 %. Raises UserInputError for fewer than 2 points, and where a larger file is not better, which
    leaves r without a value (pass `pareto`).
    """
    (r_a, q_a), (r_t, q_t) = _both(anchor, test, names, pareto=pareto)
    for name, quality in zip(names, (q_a, q_t), strict=True):
        if np.any(np.diff(quality) <= 0):
            raise UserInputError(
                f"BD-rate: in the curve of {name} a larger file is not better in {metric}: drop such points "
                "(`sw report --pareto`), or go by the BD gain"
            )
    difference = _mean_difference((q_a, r_a), (q_t, r_t), method)
    if difference.value is None:
        return difference
    with np.errstate(over="ignore"):
        percent = float(np.expm1(difference.value * np.log(10.0)) * 100.0)
    if not np.isfinite(percent):
        raise UserInputError("BD-rate: the curves lie more than 300 decades apart")
    return BdResult(percent, difference.overlap, difference.flags)


def bd_quality(
    anchor: tuple[Sequence[float], Sequence[float]],
    test: tuple[Sequence[float], Sequence[float]],
    *,
    method: Method = "pchip",
    pareto: bool = False,
    names: tuple[str, str] = ("anchor", "test"),
) -> BdResult:
    """Mean gain in quality of `test` over `anchor` at the same rate: BD-PSNR if the quality is PSNR in dB.

    Arguments as of `bd_rate`. Quality is interpolated as a function of r over the rates that both curves cover; it may
    fall. Raises UserInputError for fewer than 2 points.
    """
    a, t = _both(anchor, test, names, pareto=pareto)
    return _mean_difference(a, t, method)


def pareto_front(rates: Sequence[float], quality: Sequence[float]) -> tuple[list[float], list[float]]:
    """Points that no smaller (or equally large) file equals or beats, by rate."""
    kept: list[tuple[float, float]] = []
    for rate, value in sorted(zip(rates, quality, strict=True), key=lambda p: (p[0], -p[1])):
        if not kept or value > kept[-1][1]:
            kept.append((rate, value))
    return [rate for rate, _ in kept], [value for _, value in kept]


def _both(
    anchor: tuple[Sequence[float], Sequence[float]],
    test: tuple[Sequence[float], Sequence[float]],
    names: tuple[str, str],
    *,
    pareto: bool,
) -> tuple[tuple[Floats, Floats], tuple[Floats, Floats]]:
    return _points(anchor, names[0], pareto=pareto), _points(test, names[1], pareto=pareto)


def _points(curve: tuple[Sequence[float], Sequence[float]], name: str, *, pareto: bool) -> tuple[Floats, Floats]:
    """(log10 rate, quality) by rate, checked; `name` is for messages."""
    rates, quality = (np.asarray(list(values), dtype=np.float64) for values in curve)
    if rates.ndim != 1 or rates.shape != quality.shape:
        raise UserInputError(f"BD: {name}: {rates.size} rates and {quality.size} qualities do not make a curve")
    if not (np.all(np.isfinite(rates)) and np.all(rates > 0) and np.all(np.isfinite(quality))):
        raise UserInputError(f"BD: in the curve of {name} rates must be positive and qualities finite")
    if pareto:
        rates, quality = (np.asarray(v) for v in pareto_front(rates.tolist(), quality.tolist()))
    if rates.size < 2:
        raise UserInputError(f"BD: a curve needs at least 2 points, that of {name} has {rates.size}")
    order = np.argsort(rates, kind="stable")
    rates, quality = rates[order], quality[order]
    if np.any(np.diff(rates) == 0):
        raise UserInputError(
            f"BD: in the curve of {name} two points have the same rate: drop the worse (`sw report --pareto`)"
        )
    return np.log10(rates), quality


def _mean_difference(anchor: tuple[Floats, Floats], test: tuple[Floats, Floats], method: Method) -> BdResult:
    """Mean of y_test(x) - y_anchor(x) over the x that both curves cover."""
    (x_a, _), (x_t, _) = anchor, test
    ranges = [float(x.max() - x.min()) for x in (x_a, x_t)]
    low, high = max(float(x_a.min()), float(x_t.min())), min(float(x_a.max()), float(x_t.max()))
    shared = max(high - low, 0.0)
    flags = ("few_points",) if min(x_a.size, x_t.size) < FEWEST_POINTS else ()
    if shared <= 0:
        return BdResult(None, 0.0, (*flags, "no_overlap"))
    if shared < LOW_OVERLAP * max(ranges):
        flags = (*flags, "low_overlap")
    integrals = [
        _interpolate(x, y, method, straight="few_points" in flags).integral(low, high) for x, y in (anchor, test)
    ]
    return BdResult((integrals[1] - integrals[0]) / shared, shared / max(ranges), flags)


class _Pieces:
    """A piecewise polynomial of scipy."""

    def __init__(self, x: Floats, y: Floats, *, straight: bool) -> None:
        from scipy.interpolate import PchipInterpolator, make_interp_spline

        order = np.argsort(x)
        x, y = x[order], y[order]
        self._curve = make_interp_spline(x, y, k=1) if straight else PchipInterpolator(x, y)

    def integral(self, low: float, high: float) -> float:
        return float(self._curve.integrate(low, high))


class _Cubic:
    """Polynomial of third degree through 4 points; x is centred, which keeps the fit well conditioned."""

    def __init__(self, x: Floats, y: Floats) -> None:
        self._centre = float(x.mean())
        self._antiderivative = np.polynomial.Polynomial.fit(x - self._centre, y, deg=3).integ()

    def integral(self, low: float, high: float) -> float:
        return float(self._antiderivative(high - self._centre) - self._antiderivative(low - self._centre))


def _interpolate(x: Floats, y: Floats, method: Method, *, straight: bool) -> _Curve:
    if method == "cubic":
        if x.size != FEWEST_POINTS:
            raise UserInputError(f"BD: method 'cubic' takes exactly 4 points a curve, not {x.size}; use 'pchip'")
        return _Cubic(x, y)
    if method != "pchip":
        raise UserInputError(f"BD: there is no method '{method}': use 'pchip' or 'cubic'")
    return _Pieces(x, y, straight=straight)
