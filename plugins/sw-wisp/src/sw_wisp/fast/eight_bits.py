"""`eight_bits.rounded_weights` of many matrices in one call."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from sw_wisp.eight_bits import LOWEST_EXPONENT
from sw_wisp.fast.kernels import kernels_of


@torch.no_grad()
def in_eight_bits(weights: Sequence[Tensor], lowest: int = LOWEST_EXPONENT) -> list[Tensor]:
    """Return up to 16 weights [out,in], where the kernels fit, as the file has them; constants."""
    given = [weight.contiguous() for weight in weights]
    rounded = [torch.empty_like(weight) for weight in given]
    kernels_of(given[0]).eight_bits(
        weights=given, rounded=rounded, rows=[len(w) for w in given], columns=[w.shape[1] for w in given],
        count=len(given), lowest=lowest,
    )  # fmt: skip
    return rounded
