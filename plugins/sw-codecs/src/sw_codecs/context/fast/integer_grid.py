"""Lookup of position codes in binary hash grids by a compiled kernel, in integers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from splatwizard_native import fast_enabled
from sw_codecs.exact_native import EXACT
from sw_codecs.fast import exact_operations

MAX_FEATURES = 16
"""Signs of an entry, one bit each."""


def fits(codes: Tensor, features: int) -> bool:
    """Whether there is a kernel for codes on the CPU in grids of so many features; loads it."""
    return fast_enabled() and codes.device.type == "cpu" and features <= MAX_FEATURES and EXACT.try_load()


def integer_features(grids: Sequence[tuple[Sequence[int], Any]], codes: Tensor, dtype: torch.dtype) -> Tensor:
    """Return the `HashGrid.integer_features` of codes [n,3] in grids of given axes, side by side, where it `fits`."""
    codes, column = codes.to(torch.int64).contiguous(), 0
    found = codes.new_empty(len(codes), sum(grid.width for _, grid in grids), dtype=dtype)
    for axes, grid in grids:
        exact_operations.grid_features(
            codes, list(axes), _packed_signs(grid), grid.features, grid.integer_levels(column), grid.dense_levels,
            grid.log2_size, found,
        )  # fmt: skip
        column += grid.width
    return found


def _packed_signs(grid: Any) -> Tensor:
    """[entries] int16: bit f is 1 where number f is not negative; kept as long as the table stays as it is."""
    table = grid.table.detach()
    key = (table.data_ptr(), grid.table._version)
    kept = _SIGNS.get(grid)
    if kept is None or kept[0] != key:
        found = torch.zeros(len(table), dtype=torch.int32)
        for f, column in enumerate(table.unbind(1)):
            found |= (column >= 0).to(torch.int32) << f
        kept = _SIGNS[grid] = key, found.to(torch.int16)
    return kept[1]


_SIGNS: WeakKeyDictionary[Any, tuple[tuple[int, int], Tensor]] = WeakKeyDictionary()
