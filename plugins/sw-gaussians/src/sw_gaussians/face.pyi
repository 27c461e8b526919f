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
