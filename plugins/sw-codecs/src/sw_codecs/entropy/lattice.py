"""Lattice of the exact mode: which table codes a symbol, and about which integer, from a mean and a scale in integers.

Integer arithmetic alone, so that every machine finds the same; the formulas are those of docs/bitstream.md,
`gaussian-exact`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from sw_codecs.entropy.exact_streams import SYMBOL_LIMIT
from sw_codecs.entropy.exact_tables import FRACTIONS, exact_tables
from sw_codecs.exact_native import EXACT
from sw_codecs.fast import exact_operations

UNIT = 4096  # 12 fractional bits
PARAMETER_LIMIT = 1 << 48  # shifts and products below stay within 63 bits


def lattice(
    mean: np.ndarray | Tensor, scale: np.ndarray | Tensor, multiplier: np.ndarray | Tensor, present: Any = None
) -> tuple[np.ndarray, np.ndarray]:
    """Integer part of each mean (in steps) and table number, [m] each, of the present numbers row after row.

    mean, scale     [n,C] integers in base steps with 12 fractional bits, |value| < 2^48
    multiplier      [n,1] integers 64..16384: a row's step is base step * multiplier / 4096
    present         [n,C] bool, or None: all

    Raises ValueError if one of them is out of range, or a mean is beyond 2^30 steps.
    """
    arrays = [np.asarray(each) for each in (mean, scale, multiplier)]
    if not all(np.issubdtype(each.dtype, np.integer) for each in arrays):
        raise ValueError(f"mean, scale and multiplier must be integers, not {', '.join(str(a.dtype) for a in arrays)}")
    there = None if present is None else np.ascontiguousarray(present, bool)
    full = arrays[0].shape
    fits = len(full) == 2 and [each.shape for each in arrays[1:]] == [full, (full[0], 1)]
    if fits and arrays[0].size and EXACT.try_load():
        centre, number, status = exact_operations.lattice(
            *map(_tensor, arrays),
            None if there is None else torch.from_numpy(there),
            torch.from_numpy(exact_tables().thresholds),
        )
        if not status:
            return centre.numpy(), number.numpy()
    where = Ellipsis if there is None else there
    flat = [np.broadcast_to(each, full)[where].reshape(-1) for each in arrays]
    return _flat_lattice(*(each.astype(np.int64) for each in flat))


def _tensor(array: np.ndarray) -> Tensor:
    """int64 [n,C] for the kernel, which asks for rows without gaps; copied only if need be."""
    array = np.asarray(array, np.int64)
    rows_whole = array.shape[1] < 2 or array.strides[1] == array.itemsize
    return torch.from_numpy(array if rows_whole and array.flags.writeable else np.array(array, order="C"))


def _flat_lattice(mean: np.ndarray, scale: np.ndarray, m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    for name, array in (("mean", mean), ("scale", scale)):
        if array.size and (array.min() <= -PARAMETER_LIMIT or array.max() >= PARAMETER_LIMIT):
            raise ValueError(f"{name} is beyond 2^48")
    if m.size and (m.min() < 64 or m.max() > 4 * UNIT):
        raise ValueError("multiplier leaves 64..16384")
    eighths = (8 * mean + m // 2) // m
    centre = (eighths + 4) // 8
    if centre.size and (centre.min() <= -SYMBOL_LIMIT or centre.max() >= SYMBOL_LIMIT):
        raise ValueError("a mean is beyond 2^30 steps")
    level = np.searchsorted(exact_tables().thresholds, (np.maximum(scale, 0) << 12) // m, side="left")
    return centre, (level * FRACTIONS + (eighths + 4 - 8 * centre)).astype(np.uint16)
