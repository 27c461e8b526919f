"""Types of kernels/face.h, written by tools/make_faces.py."""

from collections.abc import Sequence
from ctypes import Array, Structure
from typing import Any

from torch import Tensor

class huffman_decode_call(Structure):
    sufficed: int

class nearest_entries_call(Structure):
    share: float

def grid_lookup(
    *,
    x: Tensor | Array[Any] | int,
    values: Tensor | Array[Any] | int,
    count: int | None = None,
    axes: int | None = None,
    entries: int | None = None,
    features: int | None = None,
    scales: Sequence[float],
    lasts: Sequence[int],
    starts: Sequence[int],
    dense: Sequence[int],
    levels: int,
    log2_size: int,
    found: Tensor | Array[Any] | int,
    width: int | None = None,
) -> Structure: ...
def grid_backward(
    *,
    x: Tensor | Array[Any] | int,
    gradient: Tensor | Array[Any] | int,
    count: int | None = None,
    axes: int | None = None,
    entries: int | None = None,
    features: int | None = None,
    scales: Sequence[float],
    lasts: Sequence[int],
    starts: Sequence[int],
    dense: Sequence[int],
    levels: int,
    log2_size: int,
    table: Tensor | Array[Any] | int,
    width: int | None = None,
    largest: Tensor | Array[Any] | int | None = None,
    sums: Tensor | Array[Any] | int | None = None,
) -> Structure: ...
def signs_lookup(
    *,
    x: Tensor | Array[Any] | int,
    table: Tensor | Array[Any] | int,
    count: int | None = None,
    columns: int | None = None,
    entries: int | None = None,
    features: int | None = None,
    axes: Sequence[int],
    dimensions: int,
    scales: Sequence[float],
    lasts: Sequence[int],
    starts: Sequence[int],
    dense: Sequence[int],
    levels: int,
    log2_size: int,
    found: Tensor | Array[Any] | int,
    row: int | None = None,
    first: int,
) -> Structure: ...
def signs_backward(
    *,
    x: Tensor | Array[Any] | int,
    table: Tensor | Array[Any] | int,
    count: int | None = None,
    columns: int | None = None,
    entries: int | None = None,
    features: int | None = None,
    axes: Sequence[int],
    dimensions: int,
    scales: Sequence[float],
    lasts: Sequence[int],
    starts: Sequence[int],
    dense: Sequence[int],
    levels: int,
    log2_size: int,
    gradient: Tensor | Array[Any] | int,
    row: int | None = None,
    first: int,
    largest: Tensor | Array[Any] | int | None = None,
    sums: Tensor | Array[Any] | int | None = None,
) -> Structure: ...
def sites_lookup(
    *,
    cells: Tensor | Array[Any] | int,
    weights: Tensor | Array[Any] | int,
    count: int | None = None,
    scales: int | None = None,
    tables: Sequence[Tensor | Array[Any] | int | None],
    rows: Sequence[int],
    channels: int,
    found: Tensor | Array[Any] | int,
    width: int | None = None,
) -> Structure: ...
def sites_backward(
    *,
    cells: Tensor | Array[Any] | int,
    weights: Tensor | Array[Any] | int,
    count: int | None = None,
    scales: int | None = None,
    gradient: Tensor | Array[Any] | int,
    width: int | None = None,
    tables: Sequence[Tensor | Array[Any] | int | None],
    channels: int,
) -> Structure: ...
def huffman_decode(
    *,
    bytes: Tensor | Array[Any] | int,
    length: int | None = None,
    counts: Tensor | Array[Any] | int,
    trees: int | None = None,
    alphabet: int | None = None,
    index: Tensor | Array[Any] | int,
    symbols: Tensor | Array[Any] | int,
    count: int | None = None,
) -> huffman_decode_call: ...
def nearest_entries(
    *,
    rows: Tensor | Array[Any] | int,
    entries: Tensor | Array[Any] | int,
    count: int | None = None,
    choices: int | None = None,
    dimensions: int | None = None,
    index: Tensor | Array[Any] | int,
) -> nearest_entries_call: ...
