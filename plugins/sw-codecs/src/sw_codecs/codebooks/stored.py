"""Codebooks as files hold them: what is read from one, and indices that survive a second encoding."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from splatwizard_core.api import BitstreamError
from sw_codecs.codebooks.nearest import nearest


def read_codebook(side: dict[str, Any], key: str, ndim: int) -> np.ndarray:
    """side[key] as float32. Raises BitstreamError unless it is a finite float array with `ndim` axes."""
    array = np.asarray(side.get(key))
    if array.ndim != ndim or array.dtype.kind != "f":
        raise BitstreamError(f"side information '{key}' is missing or no float array with {ndim} axes")
    with np.errstate(over="ignore"):
        found = array.astype(np.float32)
    if not np.isfinite(found).all():
        raise BitstreamError(f"side information '{key}' holds values that are not finite")
    return found


def settled(index: Tensor, entries: Tensor, *, block: int | None = None) -> Tensor:
    """index [N], with entries that are equal, or that the search cannot tell apart, named by one of them.

    Then the search finds for a decoded row, which is an entry, that entry again.
    """
    target = torch.arange(len(entries), device=entries.device)
    used = torch.unique(index)
    for _ in range(8):  # twice for equal entries; a chain of nearly equal ones longer than that was never seen
        found, _ = nearest(entries[used], entries, block=block)
        if torch.equal(found, used):
            break
        target[used] = found
        target = target[target]
        used = torch.unique(target[used])
    return target[index]
