"""Types of kernels/face.h, written by tools/make_faces.py."""

from ctypes import Array, Structure
from typing import Any

from torch import Tensor

class photometric_call(Structure):
    l1: float
    ssim: float

class adam_update(Structure):
    param: int | None
    grad: int | None
    exp_avg: int | None
    exp_avg_sq: int | None
    count: int
    lr: float
    beta1: float
    beta2: float
    eps: float
    step: int

def photometric(
    *,
    x: Tensor | Array[Any] | int,
    y: Tensor | Array[Any] | int,
    planes: int | None = None,
    height: int | None = None,
    width: int | None = None,
    valid: int,
    l1_weight: float,
    ssim_weight: float,
    grad: Tensor | Array[Any] | int | None = None,
    row_sums: Tensor | Array[Any] | int,
) -> photometric_call: ...
def adam(
    *,
    updates: Tensor | Array[Any] | int,
    count: int,
) -> Structure: ...
