"""Measurement of how strongly pictures depend on the precision of each attribute."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from sw_gaussians import heap

from splatwizard_core.api import GaussianModel, track
from sw_compress.allocation import Curve
from sw_compress.stages import give_back

if TYPE_CHECKING:
    from sw_compress.coders import Quantized
    from sw_compress.quality import Pictures

MEASURED = (0.0, 2.0)
"""Levels that are drawn; between and beyond them the error is a power of the step."""
COARSER = (4.0, 6.0)
"""Levels that are drawn besides where the error is too small to tell how it grows."""
SMALL = 1e-6
"""Mean squared error below which it is: 60 dB."""
POWERS = (1.0, 2.6)
"""Of the step by which an error grows: 2 where renders are smooth in an attribute."""


class Errors:
    """Errors of each attribute alone at its levels, on a model as it is.

    pictures    of that model's source
    """

    def __init__(self, coder: Quantized, model: GaussianModel, pictures: Pictures) -> None:
        names = coder.attributes(model)
        finest = coder.finest(model)
        self._measured: dict[str, tuple[list[float], list[float]]] = {}
        self._corrections: dict[str, tuple[np.ndarray | float, float]] = {}
        with track("measure precision", total=1 + len(names) * len(MEASURED), unit="models") as bar:
            rounding = coder.rounding(model)
            give_back()
            whole = rounding.model_at(coder.whole_steps(finest))
            give_back()
            self.floor = pictures.error(whole)
            bar.advance()
            for name in names:
                levels, logs = list[float](), list[float]()
                for level in (*MEASURED, *COARSER):
                    if level > coder.levels(name)[-1] or (level not in MEASURED and 2.0 ** logs[-1] > SMALL):
                        continue
                    steps = coder.whole_steps({**finest, name: level})
                    rounding.change(whole, name, steps)
                    heap.trim()
                    error = pictures.error(whole) - self.floor
                    levels, logs = [*levels, level], [*logs, float(np.log2(max(error, 1e-14)))]
                    bar.advance(level in MEASURED)
                self._measured[name] = levels, logs
                rounding.change(whole, name, coder.whole_steps(finest))
                give_back()

    def at(self, name: str, levels: np.ndarray) -> np.ndarray:
        """Mean squared error [L]."""
        known, logs = self._measured[name]
        low, high = (
            float(np.clip((logs[j] - logs[i]) / (known[j] - known[i]), *POWERS)) for i, j in ((0, 1), (-2, -1))
        )
        if len(known) > len(MEASURED):  # the least are noise: the error grows as it does where it can be seen
            below = logs[-1] + high * (levels - known[-1])
        else:
            below = logs[0] + low * (levels - known[0])
        between = np.interp(levels, known, logs)
        found = np.where(levels > known[-1], logs[-1] + high * (levels - known[-1]), between)
        found = np.where(levels < known[0], below, found)
        result: np.ndarray = 2.0**found
        return result

    def correct(self, name: str, size: np.ndarray, error: float) -> None:
        """Multiply bytes [L] at the levels of an attribute, and its errors, in all curves."""
        self._corrections[name] = size, error

    def correction(self, levels: Mapping[str, float]) -> float:
        """Factor on the sum of the errors of these levels."""
        plain = {name: float(self.at(name, np.array([level]))[0]) for name, level in levels.items()}
        whole = sum(error * self._corrections.get(name, (1.0, 1.0))[1] for name, error in plain.items())
        return whole / max(sum(plain.values()), 1e-30)

    def curves(self, coder: Quantized, model: GaussianModel) -> list[Curve]:
        """Bytes and errors of all attributes of a model, which may be a part of the one that was measured."""
        found = []
        for name, size in coder.sizes(model).items():
            more, worse = self._corrections.get(name, (1.0, 1.0))
            levels = coder.levels(name)
            found.append(Curve(name, levels, more * size, worse * self.at(name, levels), name == "positions").finer())
        return found
