"""Types of exact_kernels/face.h, written by tools/make_faces.py."""

from collections.abc import Sequence
from ctypes import Array, Structure
from typing import Any

from torch import Tensor

class lattice_call(Structure):
    status: int

class decode_streams_call(Structure):
    status: int

class encode_streams_call(Structure):
    written: int

class decode_planes_call(Structure):
    status: int

class encode_planes_call(Structure):
    written: int

class decode_octree_call(Structure):
    status: int

class decode_bits_call(Structure):
    status: int

class range_bits_call(Structure):
    status: int

class range_entries_call(Structure):
    status: int

class range_choices_call(Structure):
    status: int

class decode_leaf_octree_call(Structure):
    status: int

class forecast_call(Structure):
    status: int

class decode_mixtures_call(Structure):
    status: int

class encode_mixtures_call(Structure):
    written: int

class mixture_rows_call(Structure):
    status: int

def lattice(
    *,
    mean: Tensor | Array[Any] | int,
    scale: Tensor | Array[Any] | int,
    multiplier: Tensor | Array[Any] | int,
    mean_stride: int,
    scale_stride: int,
    multiplier_stride: int,
    present: Tensor | Array[Any] | int | None = None,
    start: Tensor | Array[Any] | int | None = None,
    rows: int | None = None,
    columns: int | None = None,
    thresholds: Tensor | Array[Any] | int,
    centre: Tensor | Array[Any] | int,
    number: Tensor | Array[Any] | int,
    count: int | None = None,
) -> lattice_call: ...
def present_rows(
    *,
    centre: Tensor | Array[Any] | int,
    number: Tensor | Array[Any] | int,
    present: Tensor | Array[Any] | int,
    start: Tensor | Array[Any] | int,
    rows: int | None = None,
    columns: int | None = None,
    to_centre: Tensor | Array[Any] | int,
    to_number: Tensor | Array[Any] | int,
    count: int | None = None,
) -> Structure: ...
def put_values(
    *,
    symbols: Tensor | Array[Any] | int,
    count: int | None = None,
    present: Tensor | Array[Any] | int | None = None,
    start: Tensor | Array[Any] | int | None = None,
    step: Tensor | Array[Any] | int,
    rows: int | None = None,
    columns: int | None = None,
    values: Tensor | Array[Any] | int,
    values_stride: int,
    integers: Tensor | Array[Any] | int,
) -> Structure: ...
def decode_streams(
    *,
    shares: Tensor | Array[Any] | int,
    first: Tensor | Array[Any] | int,
    radius: Tensor | Array[Any] | int,
    bucket: Tensor | Array[Any] | int,
    data: Tensor | Array[Any] | int,
    bytes: int | None = None,
    sizes: Tensor | Array[Any] | int,
    offsets: Tensor | Array[Any] | int,
    streams: int | None = None,
    centre: Tensor | Array[Any] | int,
    number: Tensor | Array[Any] | int,
    symbols: Tensor | Array[Any] | int,
    count: int | None = None,
) -> decode_streams_call: ...
def encode_streams(
    *,
    shares: Tensor | Array[Any] | int,
    first: Tensor | Array[Any] | int,
    radius: Tensor | Array[Any] | int,
    bucket: Tensor | Array[Any] | int,
    symbols: Tensor | Array[Any] | int,
    centre: Tensor | Array[Any] | int,
    number: Tensor | Array[Any] | int,
    count: int | None = None,
    data: Tensor | Array[Any] | int,
    room: int | None = None,
    sizes: Tensor | Array[Any] | int,
    offsets: Tensor | Array[Any] | int,
    streams: int | None = None,
) -> encode_streams_call: ...
def decode_planes(
    *,
    shares: Tensor | Array[Any] | int,
    first: Tensor | Array[Any] | int,
    radius: Tensor | Array[Any] | int,
    bucket: Tensor | Array[Any] | int,
    data: Tensor | Array[Any] | int,
    bytes: int | None = None,
    sizes: Tensor | Array[Any] | int,
    offsets: Tensor | Array[Any] | int,
    parts: Tensor | Array[Any] | int,
    bundles: Tensor | Array[Any] | int,
    streams: int | None = None,
    planes: Sequence[Tensor | Array[Any] | int | None],
    channels: Sequence[int],
    height: Sequence[int],
    width: Sequence[int],
    scales: int,
    weights: Tensor | Array[Any] | int,
    orientations: int | None = None,
) -> decode_planes_call: ...
def encode_planes(
    *,
    shares: Tensor | Array[Any] | int,
    first: Tensor | Array[Any] | int,
    radius: Tensor | Array[Any] | int,
    bucket: Tensor | Array[Any] | int,
    parts: Tensor | Array[Any] | int,
    bundles: Tensor | Array[Any] | int,
    planes: Sequence[Tensor | Array[Any] | int | None],
    channels: Sequence[int],
    height: Sequence[int],
    width: Sequence[int],
    scales: int,
    weights: Tensor | Array[Any] | int,
    orientations: int | None = None,
    data: Tensor | Array[Any] | int,
    room: int | None = None,
    sizes: Tensor | Array[Any] | int,
    offsets: Tensor | Array[Any] | int,
    streams: int | None = None,
) -> encode_planes_call: ...
def decode_octree(
    *,
    words: Tensor | Array[Any] | int,
    bytes: int | None = None,
    counts: Tensor | Array[Any] | int,
    depth: int | None = None,
    points: int | None = None,
    nodes: Tensor | Array[Any] | int,
    occupancies: Tensor | Array[Any] | int,
    sizes: Tensor | Array[Any] | int,
) -> decode_octree_call: ...
def decode_bits(
    *,
    words: Tensor | Array[Any] | int,
    bytes: int | None = None,
    zeros: int,
    bits: Tensor | Array[Any] | int,
    count: int | None = None,
) -> decode_bits_call: ...
def range_bits(
    *,
    words: Tensor | Array[Any] | int,
    bytes: int | None = None,
    state: Tensor | Array[Any] | int,
    zeros: Tensor | Array[Any] | int,
    bits: Tensor | Array[Any] | int,
    count: int | None = None,
) -> range_bits_call: ...
def range_entries(
    *,
    shares: Tensor | Array[Any] | int,
    first: Tensor | Array[Any] | int,
    radius: Tensor | Array[Any] | int,
    bucket: Tensor | Array[Any] | int,
    words: Tensor | Array[Any] | int,
    bytes: int | None = None,
    state: Tensor | Array[Any] | int,
    number: Tensor | Array[Any] | int,
    entries: Tensor | Array[Any] | int,
    numbers: int | None = None,
    count: int | None = None,
) -> range_entries_call: ...
def range_choices(
    *,
    words: Tensor | Array[Any] | int,
    bytes: int | None = None,
    state: Tensor | Array[Any] | int,
    counts: Tensor | Array[Any] | int,
    entries: Tensor | Array[Any] | int,
    count: int | None = None,
) -> range_choices_call: ...
def decode_leaf_octree(
    *,
    words: Tensor | Array[Any] | int,
    bytes: int | None = None,
    state: Tensor | Array[Any] | int,
    zeros: Tensor | Array[Any] | int,
    known_start: Tensor | Array[Any] | int,
    known_cells: Tensor | Array[Any] | int,
    known_counts: Tensor | Array[Any] | int,
    known: int | None = None,
    rows: int | None = None,
    levels: Tensor | Array[Any] | int,
    codes: Tensor | Array[Any] | int,
) -> decode_leaf_octree_call: ...
def network(
    *,
    inputs: Tensor | Array[Any] | int | None = None,
    further: Tensor | Array[Any] | int | None = None,
    columns: int | None = None,
    more: int | None = None,
    stride: int,
    further_stride: int,
    short_inputs: Tensor | Array[Any] | int | None = None,
    short_columns: int | None = None,
    weights: Tensor | Array[Any] | int,
    numbers: int | None = None,
    widths: Tensor | Array[Any] | int,
    ends: int | None = None,
    leak: int,
    outputs: Tensor | Array[Any] | int,
    rows: int | None = None,
    last: int | None = None,
) -> Structure: ...
def forecast(
    *,
    inputs: Tensor | Array[Any] | int | None = None,
    further: Tensor | Array[Any] | int | None = None,
    columns: int | None = None,
    more: int | None = None,
    stride: int,
    further_stride: int,
    short_inputs: Tensor | Array[Any] | int | None = None,
    short_columns: int | None = None,
    weights: Tensor | Array[Any] | int,
    numbers: int | None = None,
    widths: Tensor | Array[Any] | int,
    ends: int | None = None,
    rows: int | None = None,
    multipliers: Tensor | Array[Any] | int,
    thresholds: Tensor | Array[Any] | int,
    centre: Sequence[Tensor | Array[Any] | int | None],
    number: Sequence[Tensor | Array[Any] | int | None],
    group_columns: Sequence[int],
    steps: Tensor | Array[Any] | int,
    groups: int | None = None,
) -> forecast_call: ...
def grid_features(
    *,
    codes: Tensor | Array[Any] | int,
    axes: Sequence[int],
    dimensions: int,
    signs: Tensor | Array[Any] | int,
    entries: int | None = None,
    features: int,
    levels: Tensor | Array[Any] | int,
    depth: int | None = None,
    dense: int,
    log2_size: int,
    found: Tensor | Array[Any] | int | None = None,
    short_found: Tensor | Array[Any] | int | None = None,
    rows: int | None = None,
    width: int | None = None,
) -> Structure: ...
def triplane_features(
    *,
    places: Tensor | Array[Any] | int,
    planes: Sequence[Tensor | Array[Any] | int | None],
    sizes: Sequence[int],
    scales: int,
    channels: int,
    found: Tensor | Array[Any] | int,
    rows: int | None = None,
    width: int | None = None,
) -> Structure: ...
def decode_mixtures(
    *,
    below: Tensor | Array[Any] | int,
    escape: Tensor | Array[Any] | int,
    first: Tensor | Array[Any] | int,
    radius: Tensor | Array[Any] | int,
    order: Tensor | Array[Any] | int,
    half_width: Tensor | Array[Any] | int,
    shift: Tensor | Array[Any] | int,
    number: Tensor | Array[Any] | int,
    weight: Tensor | Array[Any] | int,
    count: int | None = None,
    words: Tensor | Array[Any] | int,
    bytes: int | None = None,
    entries: Tensor | Array[Any] | int,
) -> decode_mixtures_call: ...
def encode_mixtures(
    *,
    below: Tensor | Array[Any] | int,
    escape: Tensor | Array[Any] | int,
    first: Tensor | Array[Any] | int,
    radius: Tensor | Array[Any] | int,
    order: Tensor | Array[Any] | int,
    half_width: Tensor | Array[Any] | int,
    shift: Tensor | Array[Any] | int,
    number: Tensor | Array[Any] | int,
    weight: Tensor | Array[Any] | int,
    count: int | None = None,
    entries: Tensor | Array[Any] | int,
    words: Tensor | Array[Any] | int,
    room: int | None = None,
) -> encode_mixtures_call: ...
def mixture_rows(
    *,
    parts: Sequence[Tensor | Array[Any] | int | None],
    strides: Sequence[int],
    step: Tensor | Array[Any] | int,
    step_stride: int,
    rows: int | None = None,
    columns: int | None = None,
    multipliers: Tensor | Array[Any] | int,
    thresholds: Tensor | Array[Any] | int,
    radius: Tensor | Array[Any] | int,
    half_widths: Tensor | Array[Any] | int,
    widths: int | None = None,
    centre: Tensor | Array[Any] | int,
    width: Tensor | Array[Any] | int,
    order: Tensor | Array[Any] | int,
    shift: Tensor | Array[Any] | int,
    number: Tensor | Array[Any] | int,
    weight: Tensor | Array[Any] | int,
) -> mixture_rows_call: ...
