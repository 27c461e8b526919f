"""PSNR of two renders for tables: capped for equal images, an error for non-finite ones."""

from __future__ import annotations

import math

from torch import Tensor

from splatwizard_core.api import UserInputError, psnr

MAX_PSNR = 100.0
"""PSNR of equal images, dB; equals an RMS error of 1e-5."""


def capped_psnr(a: Tensor, b: Tensor) -> float:
    """Return the PSNR of two pictures [3,H,W] in 0..1, dB, at most `MAX_PSNR`.

    Raises UserInputError if one of them holds values that are no numbers, ShapeError if the shapes differ.
    """
    found = psnr(a, b)
    if math.isnan(found):
        raise UserInputError(
            "a picture holds values that are no numbers, so it has no PSNR: the model has Gaussians that cannot be "
            "drawn, or its rasterizer is at fault (--set raster.prefer=reference draws with another)"
        )
    return min(found, MAX_PSNR)
