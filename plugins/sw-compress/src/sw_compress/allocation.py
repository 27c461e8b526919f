"""Precision shared out among attributes: least error of the picture for so many bytes, by tables alone.

Errors of different attributes are independent, so they add; so do bytes. At the optimum every attribute gains as much
error by its last byte: one price of error for bytes decides all levels.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FINER = 64
"""Levels that are told apart between two of a table: a file in steps of less than half a per cent."""
BISECTIONS = 60


@dataclass(frozen=True)
class Curve:
    """Bytes and error of one attribute by its level.

    levels      [L] ascending, octaves of its step; higher is coarser
    bytes       [L]
    error       [L] mean squared error of the pictures
    whole       whether only these levels are possible, none between
    """

    name: str
    levels: Array
    bytes: Array
    error: Array
    whole: bool = False

    def finer(self) -> Curve:
        """The same at more levels, monotone: coarser is never larger, nor better."""
        size = np.minimum.accumulate(self.bytes)
        error = np.maximum.accumulate(np.maximum(self.error, 1e-300))
        if self.whole:
            return Curve(self.name, self.levels, size, error, True)
        levels = np.linspace(self.levels[0], self.levels[-1], FINER * (len(self.levels) - 1) + 1)
        between = np.exp(np.interp(levels, self.levels, np.log(error)))
        return Curve(self.name, levels, np.interp(levels, self.levels, size), between)

    def sized(self, size: Array) -> Curve:
        """The same with other bytes [K], at levels evenly spread from the first to the last."""
        known = np.linspace(self.levels[0], self.levels[-1], len(size))
        return replace(self, bytes=np.interp(self.levels, known, np.minimum.accumulate(size)))


@dataclass(frozen=True)
class Allocation:
    """Levels by attribute, and what the tables say of them."""

    levels: Mapping[str, float]
    bytes: float
    error: float


def at_price(curves: Sequence[Curve], price: float) -> Allocation:
    """The levels of least error + price x bytes.

    curves  as `Curve.finer` makes them
    """
    places = [int((curve.error + price * curve.bytes).argmin()) for curve in curves]
    return _at(curves, places)


def at_levels(curves: Sequence[Curve], levels: Mapping[str, float]) -> Allocation:
    """Bytes and errors that the curves have at levels of theirs."""
    return _at(curves, [int(abs(curve.levels - levels[curve.name]).argmin()) for curve in curves])


def within(curves: Sequence[Curve], budget: float) -> Allocation | None:
    """The levels of least error in at most `budget` bytes, as near to it as levels allow; None: it is too small."""
    best: Allocation | None = None
    for fixed in _fixed(curves):
        found = _bisected(fixed, budget)
        if found is not None and (best is None or found.error < best.error):
            best = found
    return best


def of_error(curves: Sequence[Curve], error: float) -> Allocation:
    """The cheapest levels whose error is at most `error`, or the finest."""
    best: Allocation | None = None
    for fixed in _fixed(curves):
        if sum(float(curve.error[0]) for curve in fixed) > error:
            continue
        found = _bisected_error(fixed, error)
        if best is None or found.bytes < best.bytes:
            best = found
    return best or _at(curves, [0] * len(curves))


def _bisected_error(curves: Sequence[Curve], error: float) -> Allocation:
    low, high = -60.0, 20.0
    best = _at(curves, [0] * len(curves))
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        found = at_price(curves, float(np.exp(middle)))
        if found.error > error:
            high = middle
        else:
            low, best = middle, found
    return best


def _fixed(curves: Sequence[Curve]) -> Iterator[list[Curve]]:
    """The curves with each level of the first that has no levels between; these make a step in the bytes."""
    whole = next((i for i, curve in enumerate(curves) if curve.whole), None)
    if whole is None:
        yield list(curves)
        return
    chosen = curves[whole]
    for k in range(len(chosen.levels)):
        part = slice(k, k + 1)
        yield [Curve(c.name, c.levels[part], c.bytes[part], c.error[part], True) if i == whole else c
               for i, c in enumerate(curves)]  # fmt: skip


def _bisected(curves: Sequence[Curve], budget: float) -> Allocation | None:
    if sum(float(curve.bytes[-1]) for curve in curves) > budget:
        return None
    low, high = -60.0, 20.0  # logarithms of the price: from the finest to the coarsest of all
    best = at_price(curves, float(np.exp(high)))
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        found = at_price(curves, float(np.exp(middle)))
        if found.bytes > budget:
            low = middle
        else:
            high, best = middle, found
    return best if best.bytes <= budget else None


def _at(curves: Sequence[Curve], places: Sequence[int]) -> Allocation:
    pairs = list(zip(curves, places, strict=True))
    return Allocation(
        {curve.name: float(curve.levels[i]) for curve, i in pairs},
        sum(float(curve.bytes[i]) for curve, i in pairs),
        sum(float(curve.error[i]) for curve, i in pairs),
    )
