"""`ties.moved` by a compiled kernel: the same integers."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import torch

from sw_wisp.fast import exact_face
from sw_wisp.fast.exact_native import EXACT


class Tie(Protocol):
    """Protocol of the `EightBitLayer` members that are read; exponents are at least -12."""

    weights: np.ndarray
    exponents: np.ndarray


def moved(
    tie: Tie, before: slice, rows: slice | np.ndarray, parts: tuple[np.ndarray, np.ndarray, np.ndarray],
    sizes: np.ndarray,
) -> np.ndarray | None:  # fmt: skip
    """Return additions [2,n,c] to means and scale levels; None: there are no kernels, or rows are no slice.

    parts   indices, scale levels and multipliers [N,22] of all splats
    sizes   [64] of a step under each table
    """
    if not (isinstance(rows, slice) and EXACT.try_load()):
        return None
    index, scale, multiplier = (torch.from_numpy(part) for part in parts)
    weights = torch.from_numpy(tie.weights.astype(np.int64) << (tie.exponents.astype(np.int64) + 12)[:, None])
    weights = weights.view(2, -1, weights.shape[1])
    n = len(range(rows.start, rows.stop, rows.step))
    found = torch.empty(2, n, weights.shape[1], dtype=torch.int64)
    exact_face.moved(
        index=index, scale=scale, multiplier=multiplier, first=rows.start, step=rows.step, start=before.start,
        weights=weights, sizes=torch.from_numpy(sizes), moved=found,
    )  # fmt: skip
    return found.numpy()
