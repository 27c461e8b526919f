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
    total: Tensor | Array[Any] | int,
    l1: Tensor | Array[Any] | int,
    ssim: Tensor | Array[Any] | int,
    slopes: Tensor | Array[Any] | int | None = None,
    sums: Tensor | Array[Any] | int,
    sum_count: int | None = None,
    device: int | None = None,
) -> Structure: ...
def photometric_loss_backward(
    *,
    x: Tensor | Array[Any] | int,
    y: Tensor | Array[Any] | int,
    slopes: Tensor | Array[Any] | int,
    planes: int | None = None,
    height: int | None = None,
    width: int | None = None,
    valid: bool,
    l1_weight: float,
    ssim_weight: float,
    scale: Tensor | Array[Any] | int | None = None,
    grad: Tensor | Array[Any] | int,
    device: int | None = None,
) -> Structure: ...
def adam(
    *,
    updates: Tensor | Array[Any] | int,
    count: int,
    device: int | None = None,
) -> Structure: ...
