"""Types of kernels/cuda/face.h, written by tools/make_faces.py."""

from ctypes import Array, Structure
from typing import Any

from torch import Tensor

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

def photometric_loss(
    *,
    x: Tensor | Array[Any] | int,
    y: Tensor | Array[Any] | int,
    planes: int | None = None,
    height: int | None = None,
    width: int | None = None,
    valid: bool,
    l1_weight: float,
    ssim_weight: float,
    offset: float,
    found: Tensor | Array[Any] | int,
    grad: Tensor | Array[Any] | int | None = None,
    scratch: Tensor | Array[Any] | int,
    scratch_count: int | None = None,
    device: int | None = None,
) -> Structure: ...
def adam(
    *,
    updates: Tensor | Array[Any] | int,
    count: int,
    device: int | None = None,
) -> Structure: ...
