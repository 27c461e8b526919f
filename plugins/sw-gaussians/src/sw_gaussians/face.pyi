"""Types of kernels/face.h, written by tools/make_faces.py."""

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
) -> Structure: ...
def merge_partners(
    *,
    table: Tensor | Array[Any] | int,
    sh: Tensor | Array[Any] | int,
    weights: Tensor | Array[Any] | int | None = None,
    order: Tensor | Array[Any] | int,
    rows: int | None = None,
    n: int | None = None,
    width: int | None = None,
    window: int | None = None,
    wave: int,
    near: float,
    prices: Tensor | Array[Any] | int,
    best: Tensor | Array[Any] | int,
    partner: Tensor | Array[Any] | int,
) -> Structure: ...
def merge_pairs(
    *,
    means: Tensor | Array[Any] | int,
    scales: Tensor | Array[Any] | int,
    quats: Tensor | Array[Any] | int,
    opacities: Tensor | Array[Any] | int,
    sh: Tensor | Array[Any] | int,
    table: Tensor | Array[Any] | int,
    pairs: Tensor | Array[Any] | int,
    rows: int | None = None,
    n: int | None = None,
    width: int | None = None,
    unit: float,
    center: Tensor | Array[Any] | int,
    widen: int,
) -> Structure: ...
