"""Checks of the side information that quantizers read from a file; a bad one raises BitstreamError."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from splatwizard_core.api import BitstreamError


def fits(shape: tuple[int, ...], target: tuple[int, ...]) -> bool:
    """Whether an array of `shape` broadcasts to `target` without enlarging it."""
    try:
        return np.broadcast_shapes(shape, target) == target
    except ValueError:
        return False


def floats(
    side: dict[str, Any], key: str, shape: tuple[int, ...], *, positive: bool = False, dtype: Any = np.float64
) -> np.ndarray:
    """side[key] as `dtype`. Raises BitstreamError unless it is, as such, a finite float array of `shape` (and > 0)."""
    array = np.asarray(side.get(key))
    if array.dtype.kind != "f" or array.shape != shape:
        raise BitstreamError(f"side information '{key}' is missing or no float array of shape {list(shape)}")
    with np.errstate(over="ignore", under="ignore"):
        found = array.astype(dtype)
    if not np.isfinite(found).all() or (positive and not (found > 0).all()):
        raise BitstreamError(f"side information '{key}' is not finite{' and positive' if positive else ''}")
    return found


def integers(side: dict[str, Any], key: str, shape: tuple[int, ...], low: int, high: int) -> np.ndarray:
    """side[key] as int64. Raises BitstreamError unless it is an integer array of `shape` within low..high."""
    array = np.asarray(side.get(key))
    if array.dtype.kind not in "iu" or array.shape != shape:
        raise BitstreamError(f"side information '{key}' is missing or no integer array of shape {list(shape)}")
    if array.size and not low <= int(array.min()) <= int(array.max()) <= high:
        raise BitstreamError(f"side information '{key}' is outside {low}..{high}")
    return array.astype(np.int64)


def within(symbols: Tensor, low: int | Tensor, high: int | Tensor) -> Tensor:
    """`symbols` as int64. Raises BitstreamError if one is outside low..high (numbers, or tensors that broadcast)."""
    if symbols.is_floating_point() or symbols.is_complex():
        raise BitstreamError(f"quantizer indices are {symbols.dtype}, must be integers")
    index = symbols.to(torch.int64)
    if bool(((index < low) | (index > high)).any()):
        raise BitstreamError("a quantizer index is outside its range")
    return index


def finite_values(values: Tensor) -> Tensor:
    """As float32. Raises BitstreamError if one does not fit."""
    found = values.to(torch.float32)
    if not bool(torch.isfinite(found).all()):
        raise BitstreamError("a decoded value is not finite in float32")
    return found
