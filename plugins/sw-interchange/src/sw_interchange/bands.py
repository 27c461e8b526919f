"""Spherical harmonics as all formats count them: bands and their coefficients."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float32]

COEFFICIENTS = {0: 0, 1: 3, 2: 8, 3: 15, 4: 24}
"""SH degree -> coefficients per channel above band 0."""
