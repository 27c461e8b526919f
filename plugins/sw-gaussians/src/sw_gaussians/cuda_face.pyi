"""Types of kernels/cuda/face.h, written by tools/make_faces.py."""

from ctypes import Array, Structure
from typing import Any

from torch import Tensor

class sparse_update(Structure):
    param: int | None
    grad: int | None
    exp_avg: int | None
    exp_avg_sq: int | None
    width: int
    lr: float
    beta1: float
    beta2: float
    eps: float

def sparse_adam(
    *,
    updates: Tensor | Array[Any] | int,
    count: int,
    marked: Tensor | Array[Any] | int,
    rows: int | None = None,
    device: int | None = None,
) -> Structure: ...
def view_statistics(
    *,
    gradients: Tensor | Array[Any] | int,
    radii: Tensor | Array[Any] | int,
    rows: int | None = None,
    grad_accum: Tensor | Array[Any] | int,
    denom: Tensor | Array[Any] | int,
    max_radii: Tensor | Array[Any] | int,
    device: int | None = None,
) -> Structure: ...
def fragment_statistics(
    *,
    gradients: Tensor | Array[Any] | int,
    logits: Tensor | Array[Any] | int,
    fragments: Tensor | Array[Any] | int,
    rows: int | None = None,
    least_clear: float,
    sums: Tensor | Array[Any] | int,
    device: int | None = None,
) -> Structure: ...
def disagreement(
    *,
    depth: Tensor | Array[Any] | int,
    normals: Tensor | Array[Any] | int,
    alpha: Tensor | Array[Any] | int,
    height: int | None = None,
    width: int | None = None,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    found: Tensor | Array[Any] | int,
    device: int | None = None,
) -> Structure: ...
def disagreement_backward(
    *,
    grad: Tensor | Array[Any] | int,
    depth: Tensor | Array[Any] | int,
    normals: Tensor | Array[Any] | int,
    alpha: Tensor | Array[Any] | int,
    height: int | None = None,
    width: int | None = None,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    to_depth: Tensor | Array[Any] | int,
    to_normals: Tensor | Array[Any] | int,
    device: int | None = None,
) -> Structure: ...
