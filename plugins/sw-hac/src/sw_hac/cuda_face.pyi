"""Types of kernels/cuda/face.h, written by tools/make_faces.py."""

from ctypes import Array, Structure
from typing import Any

from torch import Tensor

def mixture_bits(
    *,
    x: Tensor | Array[Any] | int,
    outputs: Tensor | Array[Any] | int,
    units: Tensor | Array[Any] | int,
    columns: Tensor | Array[Any] | int | None = None,
    second: Tensor | Array[Any] | int | None = None,
    steps: Tensor | Array[Any] | int,
    masks: Tensor | Array[Any] | int,
    counted: Tensor | Array[Any] | int,
    count: int | None = None,
    numbers: int | None = None,
    width: int | None = None,
    features: int | None = None,
    k: int | None = None,
    base: float,
    smallest: float,
    smallest_scale: float,
    scale_floor: float,
    kind: int,
    bits: Tensor | Array[Any] | int,
    to_x: Tensor | Array[Any] | int,
    to_outputs: Tensor | Array[Any] | int,
    to_steps: Tensor | Array[Any] | int,
    to_masks: Tensor | Array[Any] | int,
    to_second: Tensor | Array[Any] | int | None = None,
    device: int | None = None,
) -> Structure: ...
def channel_inputs(
    *,
    x: Tensor | Array[Any] | int,
    outputs: Tensor | Array[Any] | int,
    units: Tensor | Array[Any] | int,
    count: int | None = None,
    numbers: int | None = None,
    width: int | None = None,
    features: int,
    base: float,
    context: bool,
    inputs: Tensor | Array[Any] | int,
    columns: int | None = None,
    device: int | None = None,
) -> Structure: ...
def channel_slopes(
    *,
    slope: Tensor | Array[Any] | int,
    by_x: Tensor | Array[Any] | int,
    by_outputs: Tensor | Array[Any] | int,
    by_inputs: Tensor | Array[Any] | int | None = None,
    units: Tensor | Array[Any] | int,
    count: int | None = None,
    numbers: int | None = None,
    width: int | None = None,
    features: int,
    columns: int | None = None,
    base: float,
    context: bool,
    to_x: Tensor | Array[Any] | int,
    to_outputs: Tensor | Array[Any] | int,
    device: int | None = None,
) -> Structure: ...
