"""Types of kernels/face.h, written by tools/make_faces.py."""

from collections.abc import Sequence
from ctypes import Array, Structure
from typing import Any

from torch import Tensor

def eight_bits(
    *,
    weights: Sequence[Tensor | Array[Any] | int | None],
    rounded: Sequence[Tensor | Array[Any] | int | None],
    rows: Sequence[int],
    columns: Sequence[int],
    count: int,
    lowest: int,
) -> Structure: ...
def draw(
    *,
    block: int,
    phase: int,
    sharpness: float,
    soft: Tensor | Array[Any] | int | None = None,
    adaptive: bool,
    values: Tensor | Array[Any] | int,
    noise: Tensor | Array[Any] | int | None = None,
    outputs: Tensor | Array[Any] | int,
    inputs: Tensor | Array[Any] | int,
    view_inputs: Tensor | Array[Any] | int,
    base_steps: Tensor | Array[Any] | int,
    multipliers: Tensor | Array[Any] | int,
    ties: Sequence[Tensor | Array[Any] | int | None],
    rows: int | None = None,
    mean: Tensor | Array[Any] | int,
    scale: Tensor | Array[Any] | int,
    steps: Tensor | Array[Any] | int,
    drawn: Tensor | Array[Any] | int,
    told: Tensor | Array[Any] | int,
) -> Structure: ...
def draw_backward(
    *,
    phase: int,
    sharpness: float,
    soft: Tensor | Array[Any] | int | None = None,
    adaptive: bool,
    moves_steps: bool,
    values: Tensor | Array[Any] | int,
    noise: Tensor | Array[Any] | int | None = None,
    outputs: Tensor | Array[Any] | int,
    base_steps: Tensor | Array[Any] | int,
    rows: int | None = None,
    mean: Tensor | Array[Any] | int,
    steps: Tensor | Array[Any] | int,
    by_mean: Tensor | Array[Any] | int | None = None,
    by_scale: Tensor | Array[Any] | int | None = None,
    by_steps: Tensor | Array[Any] | int | None = None,
    by_drawn: Tensor | Array[Any] | int | None = None,
    to_outputs: Tensor | Array[Any] | int,
    to_values: Tensor | Array[Any] | int,
) -> Structure: ...
def bits(
    *,
    values: Tensor | Array[Any] | int,
    mean: Tensor | Array[Any] | int,
    scale: Tensor | Array[Any] | int,
    steps: Tensor | Array[Any] | int,
    rows: int | None = None,
    last: int | None = None,
    bits: Tensor | Array[Any] | int,
) -> Structure: ...
def bits_backward(
    *,
    values: Tensor | Array[Any] | int,
    mean: Tensor | Array[Any] | int,
    scale: Tensor | Array[Any] | int,
    steps: Tensor | Array[Any] | int,
    rows: int | None = None,
    last: int | None = None,
    by_bits: Tensor | Array[Any] | int,
    to_values: Tensor | Array[Any] | int,
    to_mean: Tensor | Array[Any] | int,
    to_scale: Tensor | Array[Any] | int,
    to_steps: Tensor | Array[Any] | int,
) -> Structure: ...
def splats(
    *,
    values: Tensor | Array[Any] | int,
    log_edges: Tensor | Array[Any] | int,
    low: float,
    high: float,
    rows: int | None = None,
    covariances: Tensor | Array[Any] | int,
    opacities: Tensor | Array[Any] | int,
    dc: Tensor | Array[Any] | int,
    axes: Tensor | Array[Any] | int,
) -> Structure: ...
def splats_backward(
    *,
    low: float,
    high: float,
    rows: int | None = None,
    axes: Tensor | Array[Any] | int,
    opacities: Tensor | Array[Any] | int,
    by_covariances: Tensor | Array[Any] | int | None = None,
    by_opacities: Tensor | Array[Any] | int | None = None,
    by_dc: Tensor | Array[Any] | int | None = None,
    by_colour: Tensor | Array[Any] | int | None = None,
    to_values: Tensor | Array[Any] | int,
) -> Structure: ...
