"""Measurement of how strongly pictures depend on the precision of each attribute."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from splatwizard_core.api import GaussianModel, track
from sw_compress.allocation import Curve

if TYPE_CHECKING:
    from sw_compress.coders import Quantized
    from sw_compress.quality import Pictures

MEASURED = (0.0, 2.0)
"""Levels that are drawn; between and beyond them the error is a power of the step."""
POWERS = (1.0, 2.6)
"""Of the step by which an error grows: 2 where renders are smooth in an attribute."""


class Errors:
    """Errors of each attribute alone at its levels, on a model as it is.

    pictures    of that model's source
    """

    def __init__(self, coder: Quantized, model: GaussianModel, pictures: Pictures) -> None:
        names = coder.attributes(model)
        finest = coder.finest(model)
        self._power: dict[str, tuple[float, float]] = {}
        with track("measure precision", total=1 + len(names) * len(MEASURED), unit="models") as bar:
            self.floor = pictures.error(coder.rounded(model, finest))
            bar.advance()
            for name in names:
                found = []
                for level in MEASURED:
                    error = pictures.error(coder.rounded(model, {**finest, name: level})) - self.floor
                    found.append(max(error, 1e-14))
                    bar.advance()
                power = np.log2(found[1] / found[0]) / (MEASURED[1] - MEASURED[0])
                self._power[name] = found[0], float(np.clip(power, *POWERS))

    def at(self, name: str, levels: np.ndarray) -> np.ndarray:
        """Mean squared error [L]."""
        error, power = self._power[name]
        found: np.ndarray = error * 2.0 ** (power * levels)
        return found

    def curves(self, coder: Quantized, model: GaussianModel) -> list[Curve]:
        """Bytes and errors of all attributes of a model, which may be a part of the one that was measured."""
        return [
            Curve(name, coder.levels(name), size, self.at(name, coder.levels(name)), name == "positions").finer()
            for name, size in coder.sizes(model).items()
        ]
