"""Types of exact_kernels/ties_face.h, written by tools/make_faces.py."""

from ctypes import Array, Structure
from typing import Any

from torch import Tensor

def pyramid_features(
    *,
    rows: Tensor | Array[Any] | int,
    levels: Tensor | Array[Any] | int,
    leaf: Tensor | Array[Any] | int,
    parent: Tensor | Array[Any] | int,
    depth: Tensor | Array[Any] | int,
    starts: Tensor | Array[Any] | int,
    base_prior: Tensor | Array[Any] | int,
    view_prior: Tensor | Array[Any] | int,
    base_sums: Tensor | Array[Any] | int | None = None,
    view_sums: Tensor | Array[Any] | int | None = None,
    needed: Tensor | Array[Any] | int,
    means: Tensor | Array[Any] | int,
    n: int | None = None,
    splats: int | None = None,
    cells: int | None = None,
    found: Tensor | Array[Any] | int,
) -> Structure: ...
def pyramid_add(
    *,
    rows: Tensor | Array[Any] | int,
    leaf: Tensor | Array[Any] | int,
    parent: Tensor | Array[Any] | int,
    values: Tensor | Array[Any] | int,
    indices: Tensor | Array[Any] | int | None = None,
    first: int,
    n: int | None = None,
    splats: int | None = None,
    cells: int,
    columns: int | None = None,
    width: int | None = None,
    own: Tensor | Array[Any] | int,
    sums: Tensor | Array[Any] | int,
) -> Structure: ...
def moved(
    *,
    index: Tensor | Array[Any] | int,
    scale: Tensor | Array[Any] | int,
    multiplier: Tensor | Array[Any] | int,
    splats: int | None = None,
    first: int,
    step: int,
    start: int,
    weights: Tensor | Array[Any] | int,
    sizes: Tensor | Array[Any] | int,
    n: int | None = None,
    columns: int | None = None,
    before: int | None = None,
    moved: Tensor | Array[Any] | int,
) -> Structure: ...
