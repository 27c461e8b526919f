"""Axes of charts: where the ticks stand, how they are written, and where a value lies."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

MOST_TICKS = 6


@dataclass(frozen=True)
class Axis:
    """A mapping from values to pixels.

    low, high   values at the two ends; both positive if `log`
    start, end  pixels at the two ends
    """

    low: float
    high: float
    start: float
    end: float
    log: bool = False

    def place(self, value: float) -> float:
        """Pixel of a value."""
        low, high, value = (math.log10(v) if self.log else v for v in (self.low, self.high, value))
        return self.start + (value - low) / (high - low) * (self.end - self.start)

    def ticks(self) -> list[float]:
        return log_ticks(self.low, self.high) if self.log else linear_ticks(self.low, self.high)


def fitted_axis(values: Sequence[float], start: float, end: float, *, log: bool = False, pad: float = 0.06) -> Axis:
    """An axis that holds all values with some room at both ends; one that is never empty.

    Of a logarithmic axis the values must be positive.
    """
    low, high = min(values), max(values)
    if log:
        a, b = math.log10(low), math.log10(high)
        room = max((b - a) * pad, 0.02)
        return Axis(10 ** (a - room), 10 ** (b + room), start, end, log=True)
    room = (high - low) * pad or max(abs(low) * 0.02, 1e-6)
    return Axis(low - room, high + room, start, end)


def linear_ticks(low: float, high: float, most: int = MOST_TICKS) -> list[float]:
    """Multiples of 1, 2 or 5 times a power of ten inside [low, high], at most `most`."""
    rough = (high - low) / most
    if not math.isfinite(rough) or rough <= 0:
        return [low]
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(m * power for m in (1, 2, 5, 10, 20) if m * power >= rough)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [i * step for i in range(first, last + 1)]


def log_ticks(low: float, high: float, most: int = MOST_TICKS) -> list[float]:
    """1, 2, 5 times powers of ten; all digits in a narrow range, powers alone in a wide one."""
    decades = range(math.floor(math.log10(low)) - 1, math.ceil(math.log10(high)) + 1)
    for digits in ((1, 2, 3, 4, 5, 6, 7, 8, 9), (1, 2, 5), (1,)):
        found = [m * 10.0**e for e in decades for m in digits if low <= m * 10.0**e <= high]
        if len(found) <= most:
            break
    if len(found) < 2:
        return linear_ticks(low, high, most)
    stride = math.ceil(len(found) / most)
    return found[::stride]


def tick_labels(values: Sequence[float], *, log: bool = False) -> list[str]:
    """Short texts: 0.02, 31.5, 20k, 1.5M; on a linear axis all with the same number of decimals."""
    largest = max(map(abs, values), default=0.0)
    scale, letter = next(((s, t) for s, t in ((1e9, "G"), (1e6, "M"), (1e3, "k")) if largest >= 10 * s), (1.0, ""))
    if log:
        return [_short(value) for value in values]
    scaled = [value / scale for value in values]
    decimals = next((d for d in range(9) if all(abs(v - round(v, d)) < 1e-9 for v in scaled)), 9)
    return [f"{v + 0.0:.{decimals}f}{letter if v else ''}" for v in scaled]


def _short(value: float) -> str:
    for scale, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if value >= 10 * scale:
            return f"{value / scale:.6g}{letter}"
    return f"{value:.6g}"
