"""Rate-distortion optimised quantisation: of each number the index that costs least in loss and bits together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sw_wisp.nested import UNIT, index_bits, table_levels
from sw_wisp.packets import Prediction


@dataclass(frozen=True)
class RateDistortion:
    """Chooses among the nearest index, its neighbour towards 0, and 0; for `file.encode`.

    weights     [N,22] float64 >= 0, rows of the scene: loss for each squared unit that a number is off, in the units
                of the numbers. From squared slopes S of the pictures (`sensitivity`): kappa S / (3 pixels of them)
    price       loss of a bit: lambda over the pixels of one picture
    base_steps  [22]

    Numbers are judged one by one, under the very distributions that code them: those after see what was chosen.
    """

    weights: np.ndarray
    price: float
    base_steps: np.ndarray

    def __call__(self, wanted: np.ndarray, rows: np.ndarray, columns: slice, known: Prediction) -> np.ndarray:
        """Indices [n,c] for values `wanted` [n,c] in 1/4096 base steps."""
        exact = (wanted - known.mean) / known.multiplier
        nearest = np.rint(exact)
        choices = np.stack([nearest, nearest - np.sign(nearest), np.zeros_like(nearest)])  # [3,n,c]
        loss = self.weights[rows, columns] * (known.multiplier * self.base_steps[columns] / UNIT) ** 2
        cost = loss * (choices - exact) ** 2 + self.price * index_bits(table_levels(known.scale), choices)
        best = cost.argmin(0)[None]  # the nearest, where they are equal
        found: np.ndarray = np.take_along_axis(choices, best, axis=0)[0].astype(np.int64)
        return found
