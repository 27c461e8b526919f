"""Rows of a table by index: checked once, and sorted once where sums over the readers of a row need an order."""

from __future__ import annotations

from functools import cached_property

import torch
from torch import Tensor
from torch.utils.weak import WeakIdKeyDictionary

from splatwizard_core.api import ShapeError


class Segments:
    """Rows of a table that N indices ask for; sorted when first needed, so that sums over equal ones have an order.

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
        """[N] int64: the askers, those of row 0 first, each row's in index order."""
        return torch.sort(self.indices, stable=True).indices

    @cached_property
    def offsets(self) -> Tensor:
        """[M+1] int64: where each row's askers begin in `order`."""
        users = torch.arange(self.rows + 1, device=self.indices.device)
        return torch.searchsorted(self.indices[self.order], users)


class Tables:
    """Knows the segments of indices; those that come again unchanged, as at every training step, are looked at once."""

    def __init__(self) -> None:
        self._known: WeakIdKeyDictionary = WeakIdKeyDictionary()

    def segments(self, indices: Tensor, rows: int) -> Segments:
        """Indices [N] into a table of so many rows. Raises ShapeError for an index outside."""
        if indices.is_inference():
            return Segments(indices, rows)  # without a version: nobody would notice a change
        found = self._known.get(indices)
        if found is None or found[:2] != (indices._version, rows):
            # A view, so that the entry does not keep its own key alive.
            found = self._known[indices] = (indices._version, rows, Segments(indices.view_as(indices).detach(), rows))
        segments: Segments = found[2]
        return segments
