"""Indices into a codebook: validated once, sorted once where gradient sums need a fixed order."""

from __future__ import annotations

from functools import cached_property

import torch
from torch import Tensor
from torch.utils.weak import WeakIdKeyDictionary

from splatwizard_core.api import ShapeError


class Segments:
    """N indices into a table, sorted lazily so that sums over equal indices have a fixed order.

    indices     [N] int64, each in 0 .. rows - 1
    rows        M, length of the table

    Raises ShapeError for an index outside (one look at the device, so keep the object).
    """

    def __init__(self, indices: Tensor, rows: int) -> None:
        if indices.dtype != torch.int64:
            raise ShapeError(f"codebook indices must be int64, got {indices.dtype}")
        if indices.numel() and not 0 <= int(indices.min()) <= int(indices.max()) < rows:
            raise ShapeError(
                f"codebook indices run from {int(indices.min())} to {int(indices.max())}, the codebook has {rows} rows"
            )
        self.indices = indices.contiguous()
        self.rows = rows

    @cached_property
    def order(self) -> Tensor:
        """Positions [N] int64, sorted by table row, stable."""
        return torch.sort(self.indices, stable=True).indices

    @cached_property
    def offsets(self) -> Tensor:
        """Start [M+1] int64 of each table row's segment in `order`."""
        users = torch.arange(self.rows + 1, device=self.indices.device)
        return torch.searchsorted(self.indices[self.order], users)


class Tables:
    """Cache of Segments: unchanged index tensors, as in every training step, are checked once."""

    def __init__(self) -> None:
        self._known: WeakIdKeyDictionary = WeakIdKeyDictionary()

    def segments(self, indices: Tensor, rows: int) -> Segments:
        """Return the Segments of indices [N] into a table of given size. Raises ShapeError if out of range."""
        if indices.is_inference():
            return Segments(indices, rows)  # without a version: nobody would notice a change
        found = self._known.get(indices)
        if found is None or found[:2] != (indices._version, rows):
            # A view, so that the entry does not keep its own key alive.
            found = self._known[indices] = (indices._version, rows, Segments(indices.view_as(indices).detach(), rows))
        segments: Segments = found[2]
        return segments
