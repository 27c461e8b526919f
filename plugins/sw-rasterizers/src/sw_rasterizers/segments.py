"""Rows of a table, looked up by index, with a gradient that is summed in a fixed order on every device."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.utils.weak import WeakIdKeyDictionary

from splatwizard_core.api import ShapeError


class Segments:
    """Rows of a table that N indices ask for, sorted once so that sums over equal indices have an order.

    indices     [N] int64, each in 0 .. rows - 1
    rows        M, length of the table

    Raises ShapeError for an index outside (one look at the device, so keep the object).
    """

    def __init__(self, indices: Tensor, rows: int) -> None:
        if indices.numel() and not 0 <= int(indices.min()) <= int(indices.max()) < rows:
            raise ShapeError(
                f"codebook indices run from {int(indices.min())} to {int(indices.max())}, the codebook has {rows} rows"
            )
        self.indices = indices
        ordered, self.order = torch.sort(indices, stable=True)  # [N], [N]
        self.offsets = torch.searchsorted(ordered, torch.arange(rows + 1, device=indices.device))  # [M+1]

    def sum(self, values: Tensor) -> Tensor:
        """[M, ...]: for each row of the table the sum of the `values` [N, ...] that ask for it, in index order."""
        if not len(self.order):
            return values.new_zeros(len(self.offsets) - 1, *values.shape[1:])
        flat = values.index_select(0, self.order).flatten(1)
        sums = torch.segment_reduce(flat, "sum", offsets=self.offsets, axis=0, unsafe=True)
        return sums.view(-1, *values.shape[1:])


class _Lookup(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, table: Tensor, segments: Segments) -> Tensor:
        ctx.segments = segments
        return table.index_select(0, segments.indices)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        return ctx.segments.sum(grad), None


class Tables:
    """Looks up rows of tables; indices that come again unchanged, as at every training step, are sorted once."""

    def __init__(self) -> None:
        self._known: WeakIdKeyDictionary = WeakIdKeyDictionary()

    def lookup(self, table: Tensor, indices: Tensor) -> Tensor:
        """Rows of `table` [M, ...] by `indices` [N] int64: [N, ...], differentiable by the table.

        The gradient of a row is the sum over everyone who asked for it, in the same order in every run, on CUDA too,
        where torch's own gradient of indexing adds atomically. Raises ShapeError for an index outside.
        """
        rows: Tensor = _Lookup.apply(table, self.segments(indices, len(table)))  # type: ignore[no-untyped-call]
        return rows

    def segments(self, indices: Tensor, rows: int) -> Segments:
        """Indices [N] into a table of so many rows, sorted. Raises ShapeError for an index outside."""
        if indices.is_inference():
            return Segments(indices, rows)  # without a version: nobody would notice a change
        found = self._known.get(indices)
        if found is None or found[:2] != (indices._version, rows):
            # A view, so that the entry does not keep its own key alive.
            found = self._known[indices] = (indices._version, rows, Segments(indices.view_as(indices).detach(), rows))
        segments: Segments = found[2]
        return segments
