"""Finer steps for Gaussians that weigh more in pictures: a class of each, which all its steps follow.

The error of pictures by an error of a number differs between Gaussians by factors of thousands: with equal steps most
bytes go where nobody sees them. Ideal steps fall by the root of the weight; a smaller power loses little and relies
less on where the pictures were taken.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splatwizard_core.api import BitstreamError

MOST = 4
"""Largest class; a class is half an octave of the step, class 0 has the steps of the header."""
FACTORS = np.array([2.0 ** (-(k // 2)) * (0.7071067811865476 if k % 2 else 1.0) for k in range(-MOST, MOST + 1)])


def classes_of(weights: NDArray[np.float64], power: float) -> NDArray[np.int32]:
    """Class [N] of each Gaussian, 0 for one of median weight.

    weights     [N] >= 0: squared error of pictures by a squared error of a Gaussian's colour
    power       of the weight by which steps fall, 0..1
    """
    shown = weights[weights > 0]
    relative = np.maximum(weights / np.median(shown) if len(shown) else weights, 1e-30)
    return np.clip(np.rint(2 * power * np.log2(relative)), -MOST, MOST).astype(np.int32)


def footprints(opacity_logits: NDArray[np.float32], log_scales: NDArray[np.float32]) -> NDArray[np.float64]:
    """Weights [N] for want of pictures, 0..1: opacity times the product of the two largest scales."""
    largest = np.sort(log_scales.astype(np.float64), axis=1)[:, -2:].sum(axis=1)
    found: NDArray[np.float64] = np.exp(largest - largest.max(initial=-np.inf)) / (
        1 + np.exp(-opacity_logits.astype(np.float64))
    )
    return found


def checked(classes: NDArray[np.int64]) -> NDArray[np.int32]:
    """Classes [N,1] of a file as [N]. Raises BitstreamError for one that is none."""
    if classes.size and not -MOST <= int(classes.min()) <= int(classes.max()) <= MOST:
        raise BitstreamError(f"a class of precision is beyond {MOST}")
    return classes[:, 0].astype(np.int32)


def factors(classes: NDArray[np.int32]) -> NDArray[np.float64]:
    """Multipliers [N], 1/4..4, of the steps of Gaussians of these classes."""
    found: NDArray[np.float64] = FACTORS[classes + MOST]
    return found
