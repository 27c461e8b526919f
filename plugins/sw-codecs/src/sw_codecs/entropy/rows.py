"""Distributions of a block of rows of integers, as context models predict them and entropy models take them.

`conditional-gaussian` takes a RowContext or a RowLattice, `conditional-mixture` a RowMixture.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sw_codecs.fast import exact_operations

Numbers = np.ndarray | Tensor


@dataclass(frozen=True)
class RowContext:
    """Distributions of a block; arrays or CPU tensors.

    mean, scale     [n,C]. exact: integers, base steps with 12 fractional bits; float: floats, in units of the values
    step            [n,1]. exact: multipliers 64..16384, the step is base step * multiplier / 4096; float: the step
    """

    mean: Numbers
    scale: Numbers
    step: Numbers


@dataclass(frozen=True)
class RowLattice:
    """Results of `lattice.lattice` for a block of n rows with C numbers, with the multipliers; made by the kernels.

    centre      int32 [n,C] integer parts of means, in steps
    number      int16 [n,C] table numbers
    step        int64 [n,1], 64..16384
    """

    centre: Tensor
    number: Tensor
    step: Tensor

    def present(self, present: Any) -> tuple[np.ndarray, np.ndarray]:
        """Centres and numbers [m] of the present ones, row after row; `present` [n,C] bool, or None: all."""
        if present is None:
            return self.centre.reshape(-1).numpy(), self.number.reshape(-1).numpy()
        there = torch.from_numpy(np.ascontiguousarray(present, bool))
        centre, number = exact_operations.present_rows(self.centre, self.number, there)
        return centre.numpy(), number.numpy()


@dataclass(frozen=True)
class RowMixture:
    """Distributions of a block; arrays or CPU tensors.

    mean, scale, second_mean, second_scale      [n,C], as in `RowContext`
    logit   [n,C] logarithm of how much likelier the first Gaussian is; exact: integers with 12 fractional bits
    step    [n,1], as in `RowContext`
    """

    mean: Numbers
    scale: Numbers
    second_mean: Numbers
    second_scale: Numbers
    logit: Numbers
    step: Numbers
