"""Operations of grids, planes, Huffman codes and codebooks, on the CPU and on CUDA, with room for what they write.

Callers ask first whether there are kernels (native.py), and have their plain version. RuntimeError for arguments that
do not fit. The levels of a grid are lists of scales, last vertices, first entries, whether dense; then log2_size.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd.graph import increment_version

from sw_codecs.fast import cuda_face, face

Levels = tuple[list[float], list[int], list[int], list[int], int]


def lookup(x: Tensor, values: Tensor, *levels: Any) -> Tensor:
    """Return features [n, levels * features] of places x [n,d] in a grid of values [entries, features]."""
    found = x.new_empty(len(x), len(levels[0]) * values.shape[1])
    _operations(x).grid_lookup(x=x, values=values, found=found, **_named(levels))
    return found


def backward(
    x: Tensor, gradient: Tensor, entries: int, features: int, *levels: Any, largest: Tensor | None = None
) -> Tensor:
    """Return gradients [entries, features] of the values of a `lookup` from those of its features.

    largest     on CUDA: no number of the gradient exceeds it; with it sums are the same in any order
    """
    table = x.new_zeros(entries, features)
    _operations(x).grid_backward(x=x, gradient=gradient, table=table, **_named(levels), **_sums(largest, table))
    return table


def signs_lookup(x: Tensor, axes: Sequence[int], table: Tensor, found: Tensor, first: int, *levels: Any) -> None:
    """Write features of the signs of a table into columns of `found` [n, row] from `first` on.

    axes    columns of x [n,d]
    """
    _operations(x).signs_lookup(
        x=x, axes=axes, dimensions=len(axes), table=table, found=found, first=first, **_named(levels)
    )  # fmt: skip
    increment_version(found)


def signs_backward(
    x: Tensor, axes: Sequence[int], table: Tensor, gradient: Tensor, first: int, *levels: Any,
    largest: Tensor | None = None,
) -> None:  # fmt: skip
    """Add to `table` the gradients by its signs; arguments as of `signs_lookup` and `backward`."""
    _operations(x).signs_backward(
        x=x, axes=axes, dimensions=len(axes), table=table, gradient=gradient, first=first, **_named(levels),
        **_sums(largest, table),
    )  # fmt: skip
    increment_version(table)


def sites_lookup(cells: Tensor, weights: Tensor, tables: Sequence[Tensor]) -> Tensor:
    """Return features [n, scales * 3 * C] of tables [rows, C] of the scales, on the CPU.

    cells, weights  [n, scales, 3, 4] int32 rows of the scale's table, float32
    """
    channels = tables[0].shape[1]
    if any(table.dim() != 2 or table.shape[1] != channels for table in tables) or len(tables) != cells.shape[1]:
        raise RuntimeError(f"sites_lookup: {cells.shape[1]} tables [rows, channels] are needed")
    found = weights.new_empty(len(cells), len(tables) * 3 * channels)
    face.sites_lookup(
        cells=cells, weights=weights, tables=tables, rows=[len(table) for table in tables], channels=channels,
        found=found,
    )  # fmt: skip
    return found


def sites_backward(
    cells: Tensor, weights: Tensor, gradient: Tensor, rows: Sequence[int], channels: int
) -> list[Tensor]:
    """Return gradients of tables with `rows` rows each, from those of the features of a `sites_lookup`."""
    tables = [weights.new_zeros(count, channels) for count in rows]
    face.sites_backward(
        cells=cells, weights=weights, scales=len(rows), gradient=gradient, tables=tables, channels=channels
    )
    return tables


def huffman_decode(codes: Tensor, counts: Tensor, index: Tensor) -> Tensor:
    """Return symbols [n] int32, or none if the bytes do not suffice.

    codes   [length] uint8
    counts  [trees, size] float32, no NaN
    index   [n] int64, tree of each symbol
    """
    symbols = index.new_empty(index.shape, dtype=torch.int32)
    call = face.huffman_decode(bytes=codes, counts=counts, index=index, symbols=symbols)
    return symbols if call.sufficed else symbols[:0]


def nearest_entries(rows: Tensor, entries: Tensor) -> tuple[Tensor, float]:
    """Return the nearest entry of each row, int64 [n], and the share 0..1 of the distances that were computed.

    rows, entries   [n,d], [k,d] float32 on the CPU
    """
    index = rows.new_empty(len(rows), dtype=torch.int64)
    return index, face.nearest_entries(rows=rows, entries=entries, index=index).share


def _operations(x: Tensor) -> Any:
    """The operations where a tensor is."""
    return cuda_face if x.is_cuda else face


def _sums(largest: Tensor | None, table: Tensor) -> dict[str, Tensor]:
    """Arguments that give sums one order on CUDA, if the largest number is known."""
    return {} if largest is None else {"largest": largest, "sums": torch.zeros_like(table, dtype=torch.int64)}


def _named(levels: Sequence[Any]) -> dict[str, Any]:
    scales, lasts, starts, dense, log2_size = levels
    if not len(scales) == len(lasts) == len(starts) == len(dense) <= MAX_LEVELS:
        raise RuntimeError("malformed levels")
    return {
        "scales": scales, "lasts": lasts, "starts": starts, "dense": dense, "levels": len(scales),
        "log2_size": log2_size,
    }  # fmt: skip


MAX_LEVELS = 32
"""`kMaxLevels` of kernels/grid.h."""
