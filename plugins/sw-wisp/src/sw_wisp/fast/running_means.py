"""Sums and features of `sw_wisp.pyramid` by compiled kernels, on the CPU: the same integers."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from sw_wisp.fast import exact_face


def add(
    rows: Tensor, leaf: Tensor, parent: Tensor, values: Tensor, indices: Tensor | None, first: int, own: Tensor,
    sums: Tensor,
) -> None:  # fmt: skip
    """Add numbers of splats [n,c] to columns `first` and on of their own numbers and of the sums of all cells around.

    values  whole numbers
    indices of splats that become known: activities and a count follow, and values are kept in their range; None:
            `values` are differences
    """
    exact_face.pyramid_add(
        rows=rows.contiguous(), leaf=leaf, parent=parent, values=values.long().contiguous(),
        indices=None if indices is None else indices.long().contiguous(), first=first, cells=len(parent) - 1, own=own,
        sums=sums,
    )  # fmt: skip


def features(
    rows: Tensor,
    cells: tuple[Tensor, Tensor, Tensor, Tensor, list[int]],
    prior: Sequence[Tensor],
    sums: Sequence[Tensor | None],
    room: Tensor,
    found: Tensor,
) -> None:
    """Write features int64 [n,69] of splats into `found`.

    cells   levels and finest cells of splats; parents and levels of cells; first cell of each level, and their number
    sums    of base and view numbers; None: nothing is known
    room    float64 [cells or more, 44], scratch
    """
    levels, leaf, parent, depth, starts = cells
    exact_face.pyramid_features(
        rows=rows.contiguous(), levels=levels, leaf=leaf, parent=parent, depth=depth, starts=torch.tensor(starts),
        base_prior=prior[0], view_prior=prior[1], base_sums=sums[0], view_sums=sums[1],
        needed=torch.empty(len(depth), dtype=torch.bool), means=room[: len(depth)], found=found,
    )  # fmt: skip
