"""Integer planes under spatial models as independent streams: version 2 of their section.

    u16 version: 2, u32 CRC-32 of the table file
    u32 CRC-32 of all integers as i32: scale after scale [K, C, H, W], last axis fastest
    varint channels of a stream
    for each stream: varint bytes of rANS words, varint bytes of escapes
    for each stream: its words, its escapes as Exp-Golomb bits

A stream holds some channels of one plane: no channel hangs on another. Its integers are coded along wavefronts: all
with the same column + 3 row, row after row, channel after channel. A compiled kernel decodes streams on all cores;
without one, numpy takes a symbol of each stream at a time.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from splatwizard_core.api import BitstreamError
from sw_cat_3dgs.plane_fields import Field, PlaneModel, Shape, lattice_of, predicted
from sw_cat_3dgs.stream_lanes import LaneReader, LaneWriter
from sw_codecs.bits import checksum
from sw_codecs.bits.packing import ByteReader, write_varint
from sw_codecs.entropy import exact_streams
from sw_codecs.exact_native import EXACT
from sw_codecs.fast import exact_operations

SMALLEST_STREAM = 16_384
"""Integers that a stream has on average, if it could have more: it costs some eight bytes."""
MOST_SCALES = 4
"""That the kernel takes."""


def encode(planes: Sequence[np.ndarray], models: Sequence[PlaneModel]) -> bytes:
    """Bytes of integer planes [K, C, H, W] per scale, |value| < 2^24; decoded again and compared."""
    shapes = [(p.shape[1], p.shape[2], p.shape[3]) for p in planes]
    channels = _channels_of_a_stream(shapes)
    weights, parts = weights_of(models), parts_of(len(models), shapes, channels)
    values = [np.ascontiguousarray(plane, np.int32) for plane in planes]
    if _compiled(shapes, weights):
        data, sizes = exact_operations.encode_planes(
            exact_streams.share_tables("laplace"), _tensors(values), torch.from_numpy(parts), weights
        )
        content, table = data.numpy().tobytes(), sizes.numpy()
    else:
        content, table = _encoded_in_turn(values, models, parts)
    crc = _crc(values).to_bytes(4, "little")
    head = exact_streams.prefix() + crc + write_varint(channels) + exact_streams.write_sizes(table, crc=False)
    found = head + content
    if any((a != b).any() for a, b in zip(decode(found, shapes, models), planes, strict=True)):
        raise RuntimeError("planes do not decode to what was encoded; please report this")
    return found


def decode(data: bytes, shapes: Sequence[Shape], models: Sequence[PlaneModel]) -> list[np.ndarray]:
    """Inverse of `encode`, int32. Raises BitstreamError."""
    reader = ByteReader(data)
    exact_streams.check_version(reader.integer(2), reader.integer(4))
    crc, channels = reader.integer(4), reader.varint(max([1, *(c for c, _, _ in shapes)]))
    if channels < 1:
        raise BitstreamError("a stream of no channels")
    count = sum(len(models) * -(-c // channels) for c, h, w in shapes if c * h * w)
    sizes = exact_streams.read_sizes(reader, count, crc=False)
    weights, parts = weights_of(models), parts_of(len(models), shapes, channels)
    content = reader.take(reader.left)
    if _compiled(shapes, weights):
        found = [np.zeros((len(models), *shape), np.int32) for shape in shapes]
        status = exact_operations.decode_planes(
            exact_streams.share_tables("laplace"), torch.from_numpy(np.frombuffer(content, np.uint8).copy()),
            torch.from_numpy(sizes), _tensors(found), torch.from_numpy(parts), weights,
        )  # fmt: skip
        exact_streams.refuse_damage(status)
    else:
        found = _decoded_in_turn(content, sizes, shapes, models, parts)
    if _crc(found) != crc:
        raise BitstreamError(exact_streams.CRC_DIFFERS)
    return found


def parts_of(orientations: int, shapes: Sequence[Shape], channels: int) -> np.ndarray:
    """Streams in their order, int64 [count, 4]: scale, orientation, first channel, channels."""
    rows = [
        (scale, k, first, min(channels, c - first))
        for scale, (c, h, w) in enumerate(shapes)
        if c * h * w
        for k in range(orientations)
        for first in range(0, c, channels)
    ]
    return np.array(rows, np.int64).reshape(-1, 4)


def weights_of(models: Sequence[PlaneModel]) -> Tensor | None:
    """Weights and biases of all models as the kernel takes them, float64 [K, 1058]; None for models of another kind."""
    flat = [getattr(model, "flat", None) for model in models]
    return torch.stack([each for each in flat if each is not None]) if flat and None not in flat else None


def _channels_of_a_stream(shapes: Sequence[Shape]) -> int:
    """As few as make streams of 16,384 integers on average: for as many streams as possible."""
    integers = sum(c * h * w for c, h, w in shapes)
    channels = sum(c for c, h, w in shapes if h * w)
    most = max([1, *(c for c, _, _ in shapes)])
    return min(max(1, -(-SMALLEST_STREAM * channels // max(integers, 1))), most)


def _compiled(shapes: Sequence[Shape], weights: Tensor | None) -> bool:
    return weights is not None and 0 < len(shapes) <= MOST_SCALES and EXACT.try_load()


def _tensors(planes: Sequence[np.ndarray]) -> list[Tensor]:
    return [torch.from_numpy(plane) for plane in planes]


def _crc(planes: Sequence[np.ndarray]) -> int:
    crc = 0
    for plane in planes:
        crc = checksum.crc32(np.ascontiguousarray(plane, "<i4").reshape(-1), crc)
    return crc


# Without a compiler


def _due(fields: Sequence[Field], parts: np.ndarray, step: int) -> list[tuple[int, np.ndarray]]:
    """Streams with values in a step, and the positions of those."""
    return [(s, at) for s, row in enumerate(parts.tolist()) if len(at := fields[row[0]].step(step))]


def _encoded_in_turn(
    planes: Sequence[np.ndarray], models: Sequence[PlaneModel], parts: np.ndarray
) -> tuple[bytes, np.ndarray]:
    shapes = [(p.shape[1], p.shape[2], p.shape[3]) for p in planes]
    fields = [Field(len(models), shape) for shape in shapes]
    found = []
    for field, plane in zip(fields, planes, strict=True):
        field.fill(plane)
        found.append(predicted(field, models))
    lanes = []
    for scale, k, first, count in parts.tolist():
        field, (centre, number) = fields[scale], found[scale]
        at = np.concatenate([field.step(s) for s in range(field.steps)])
        flat = planes[scale].reshape(len(models), field.channels, -1)
        symbols, means, tables = (each[k][first : first + count, at].T.reshape(-1) for each in (flat, centre, number))
        lanes.append((symbols, means, tables))  # channel after channel of each place
    return LaneWriter("laplace").encode(lanes)


def _decoded_in_turn(
    content: memoryview, sizes: np.ndarray, shapes: Sequence[Shape], models: Sequence[PlaneModel], parts: np.ndarray
) -> list[np.ndarray]:
    fields = [Field(len(models), shape) for shape in shapes]
    reader = LaneReader("laplace", content, sizes)
    for step in range(max((field.steps for field in fields), default=0)):
        expected = {
            scale: lattice_of(models, [field.neighbors(k, at) for k in range(len(models))])
            for scale, field in enumerate(fields)
            if len(at := field.step(step))
        }
        due = _due(fields, parts, step)
        asked = []
        for s, at in due:
            scale, k, first, count = parts[s].tolist()
            shape = (len(models), fields[scale].channels, len(at))
            asked.append([each.reshape(shape)[k, first : first + count].T.reshape(-1) for each in expected[scale]])
        values = reader.get([s for s, _ in due], [each[0] for each in asked], [each[1] for each in asked])
        for (s, at), got in zip(due, values, strict=True):
            scale, k, first, count = parts[s].tolist()
            fields[scale].put_some(k, slice(first, first + count), at, got.reshape(len(at), count).T)
    reader.finish()
    return [field.planes().astype(np.int32) for field in fields]
