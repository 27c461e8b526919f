"""Forecasts of a walk through packets by compiled kernels: the same integers as `sw_wisp.packets` has."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
import torch

from sw_wisp.fast import exact_face
from sw_wisp.fast.exact_native import EXACT


class Forecast(Protocol):
    """Protocol of the `Prediction` members that are read; they are [n,c] int64."""

    @property
    def mean(self) -> np.ndarray: ...
    @property
    def scale(self) -> np.ndarray: ...
    @property
    def multiplier(self) -> np.ndarray: ...


def forecasts(
    features: torch.Tensor, outputs: torch.Tensor, start: int, step_of: Sequence[int], multipliers: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Return means, scale levels and step multipliers [n,c]; None: there are no kernels.

    features    [n,f], with the running means of the block from column `start` on
    outputs     of the network
    step_of     which step output each column has
    multipliers of step outputs; None: all are base steps
    """
    if not (features.device.type == outputs.device.type == "cpu" and EXACT.try_load()):
        return None
    found = [torch.empty(len(outputs), len(step_of), dtype=torch.int64) for _ in range(3)]
    exact_face.forecasts(
        features=features, start=start, outputs=outputs, step_of=torch.tensor(step_of),
        multipliers=None if multipliers is None else torch.from_numpy(multipliers),
        mean=found[0], scale=found[1], multiplier=found[2],
    )  # fmt: skip
    mean, scale, multiplier = (each.numpy() for each in found)
    return mean, scale, multiplier


def kept(
    found: Forecast, begin: int, moved: np.ndarray | None, columns: slice, rows: slice | np.ndarray, state: Any,
    lower: int,
) -> np.ndarray | None:  # fmt: skip
    """Keep in `state` what predicts `columns` of splats `rows`; return their tables uint8 [n,c], or None.

    found   of a block whose column `begin` is the first of them
    moved   [2,n,c] additions to means and scale levels; None: nothing
    lower   scale levels by which the tables are lower

    None, and nothing done: there are no kernels, or rows are no slice.
    """
    if not (isinstance(rows, slice) and EXACT.try_load()):
        return None
    n, width = len(range(rows.start, rows.stop, rows.step)), columns.stop - columns.start
    tables = torch.empty(n, width, dtype=torch.uint8)
    mean, scale, multiplier = (
        torch.from_numpy(np.ascontiguousarray(each)) for each in (found.mean, found.scale, found.multiplier)
    )
    exact_face.kept(
        mean=mean, scale=scale, multiplier=multiplier, start=columns.start, first=rows.start, step=rows.step,
        begin=begin, lower=lower, to_mean=torch.from_numpy(state.mean), to_scale=torch.from_numpy(state.scale),
        to_multiplier=torch.from_numpy(state.multiplier), tables=tables,
        moved=None if moved is None else torch.from_numpy(moved),
    )  # fmt: skip
    return tables.numpy()


def values(
    rows: slice | np.ndarray, columns: slice, mean: np.ndarray, index: np.ndarray, multiplier: np.ndarray
) -> np.ndarray | None:
    """Return values int64 [n,c] of some columns of splats; None: there are no kernels, or rows are no slice."""
    if not (isinstance(rows, slice) and EXACT.try_load()):
        return None
    first, last, _ = columns.indices(mean.shape[1])
    n = len(range(rows.start, rows.stop, rows.step))
    found = torch.empty(n, last - first, dtype=torch.int64)
    exact_face.values(
        mean=torch.from_numpy(mean), index=torch.from_numpy(index), multiplier=torch.from_numpy(multiplier),
        first=rows.start, step=rows.step, start=first, found=found,
    )  # fmt: skip
    return found.numpy()
