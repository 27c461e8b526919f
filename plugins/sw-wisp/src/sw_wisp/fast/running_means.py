"""`sw_wisp.pyramid` by compiled kernels, on the CPU: the same integers."""

from __future__ import annotations

import torch
from torch import Tensor

from sw_wisp.fast import exact_face
from sw_wisp.fast.exact_native import EXACT
from sw_wisp.numbers import NUMBERS
from sw_wisp.pyramid import FEATURES, PARTS, Pyramid, bounded


def pyramid_of(prior: Tensor) -> Pyramid:
    """The fastest pyramid there is for the device of the prior [22]."""
    return FastPyramid(prior) if prior.device.type == "cpu" and EXACT.try_load() else Pyramid(prior)


class FastPyramid(Pyramid):
    """A Pyramid whose features hold until they are asked for again: fresh memory costs twice what is computed in it."""

    def __init__(self, prior: Tensor) -> None:
        super().__init__(prior)
        self._means_of_cells = torch.empty(0, 2 * NUMBERS, dtype=torch.float64)
        self._found = torch.empty(0, FEATURES, dtype=torch.int64)

    def add(self, rows: Tensor, part: slice, values: Tensor, indices: Tensor) -> None:
        number = PARTS.index(part)
        self._known[number] = True
        self._change(rows, number, 0, values, indices)

    def refine(self, rows: Tensor, columns: slice, before: Tensor, after: Tensor) -> None:
        self._change(rows, 0, columns.start, bounded(after) - bounded(before), None)

    def _change(self, rows: Tensor, part: int, first: int, values: Tensor, indices: Tensor | None) -> None:
        """Add values [n,c] to columns `first` and on; with indices, of splats that become known, all that follows."""
        if len(rows):
            exact_face.pyramid_add(
                rows=rows.contiguous(), leaf=self._leaf, parent=self._parent, values=values.long().contiguous(),
                indices=None if indices is None else indices.long().contiguous(), first=first, cells=len(self._keys),
                own=self._own[part], sums=self._sums[part],
            )  # fmt: skip

    def features(self, rows: Tensor) -> Tensor:
        if not len(rows):
            return super().features(rows)
        cells, half = len(self._keys), (len(self) + 1) // 2  # as many rows as the last part has
        if len(self._means_of_cells) < cells:
            self._means_of_cells = torch.empty(cells, 2 * NUMBERS, dtype=torch.float64)
        if len(self._found) < len(rows):
            self._found = torch.empty(max(len(rows), half), FEATURES, dtype=torch.int64)
        base, view = (sums if known else None for sums, known in zip(self._sums, self._known, strict=True))
        exact_face.pyramid_features(
            rows=rows.contiguous(), levels=self._levels, leaf=self._leaf, parent=self._parent, depth=self._depth,
            starts=torch.tensor(self._starts), base_prior=self._prior[0], view_prior=self._prior[1], base_sums=base,
            view_sums=view, needed=torch.empty(cells, dtype=torch.bool), means=self._means_of_cells[:cells],
            found=self._found[: len(rows)],
        )  # fmt: skip
        return self._found[: len(rows)]
