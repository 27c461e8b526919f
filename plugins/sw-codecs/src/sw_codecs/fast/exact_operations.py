"""Operations of the exact mode on tensors: allocate what the compiled kernels write, and call them.

All tensors are on the CPU. A status is 0, or what is wrong (`Status` in exact_kernels/kernels.h). RuntimeError for
arguments that do not fit. Callers ask first whether there are kernels (exact_native.py), and have their plain version.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from sw_codecs.fast import exact_face as face

STREAM = 1 << 16


def lattice(
    mean: Tensor, scale: Tensor, multiplier: Tensor, present: Tensor | None, thresholds: Tensor
) -> tuple[Tensor, Tensor, int]:
    """Return (integer parts [m] int32, table numbers [m] int16, status) of the present ones of [n,C] numbers."""
    count, start = _counted(present, mean)
    centre, number = mean.new_empty(count, dtype=torch.int32), mean.new_empty(count, dtype=torch.int16)
    call = face.lattice(
        mean=mean, scale=scale, multiplier=multiplier, mean_stride=_gapless(mean), scale_stride=_gapless(scale),
        multiplier_stride=_gapless(multiplier), present=present, start=start, thresholds=thresholds, centre=centre,
        number=number,
    )  # fmt: skip
    return centre, number, call.status


def present_rows(centre: Tensor, number: Tensor, present: Tensor) -> tuple[Tensor, Tensor]:
    """Return the present ones [m] of centres int32 and numbers int16 [n,C]."""
    count, start = _counted(present, centre)
    to_centre, to_number = centre.new_empty(count), number.new_empty(count)
    face.present_rows(
        centre=centre, number=number, present=present, start=start, to_centre=to_centre, to_number=to_number
    )
    return to_centre, to_number


def put_values(symbols: Tensor, present: Tensor | None, step: Tensor, values: Tensor) -> Tensor:
    """Return symbols [m] int32 as integers [n,C] int64, 0 where not present; write integer * step into `values`."""
    _, start = _counted(present, values)
    integers = values.new_empty(values.shape, dtype=torch.int64)
    face.put_values(
        symbols=symbols, present=present, start=start, step=step, values=values, values_stride=_gapless(values),
        integers=integers,
    )  # fmt: skip
    torch.autograd.graph.increment_version(values)
    return integers


def decode_streams(
    tables: Sequence[Tensor], data: Tensor, sizes: Tensor, centre: Tensor, number: Tensor
) -> tuple[Tensor, int]:
    """Return (symbols [n] int32, status) of streams with `sizes` [streams, 3]: anything, bytes of words, of escapes."""
    symbols = torch.empty_like(centre)
    call = face.decode_streams(
        **_named(tables), data=data, sizes=sizes, offsets=_scratch(len(sizes)), centre=centre, number=number,
        symbols=symbols,
    )  # fmt: skip
    return symbols, call.status


def encode_streams(tables: Sequence[Tensor], symbols: Tensor, centre: Tensor, number: Tensor) -> tuple[Tensor, Tensor]:
    """Return (data, sizes) as `decode_streams` takes them, of symbols [n] int32."""
    count = len(symbols)
    streams = -(-count // STREAM)
    data, sizes = _room(count, streams), torch.zeros(streams, 3, dtype=torch.int64)
    call = face.encode_streams(
        **_named(tables), symbols=symbols, centre=centre, number=number, data=data, sizes=sizes,
        offsets=_scratch(streams),
    )  # fmt: skip
    return data[: call.written], sizes


def decode_planes(
    tables: Sequence[Tensor], data: Tensor, sizes: Tensor, planes: Sequence[Tensor], parts: Tensor, weights: Tensor
) -> int:
    """Fill planes int32 [K,C,H,W] of each scale; return the status. `parts` [streams, 4] as in exact_kernels/face.h."""
    call = face.decode_planes(
        **_named(tables), **_planes(planes, weights), data=data, sizes=sizes, offsets=_scratch(len(parts)),
        parts=parts, bundles=_scratch(len(parts) + 1), weights=weights,
    )  # fmt: skip
    return int(call.status)


def encode_planes(
    tables: Sequence[Tensor], planes: Sequence[Tensor], parts: Tensor, weights: Tensor
) -> tuple[Tensor, Tensor]:
    """Return (data, sizes) of planes."""
    size = torch.tensor([plane.shape[2] * plane.shape[3] for plane in planes])
    count = int((size[parts[:, 0]] * parts[:, 3]).sum())
    data, sizes = _room(count, len(parts)), torch.zeros(len(parts), 3, dtype=torch.int64)
    call = face.encode_planes(
        **_named(tables), **_planes(planes, weights), parts=parts, bundles=_scratch(len(parts) + 1), weights=weights,
        data=data, sizes=sizes, offsets=_scratch(len(parts)),
    )  # fmt: skip
    return data[: call.written], sizes


def decode_octree(words: Tensor, counts: Tensor, points: int) -> tuple[Tensor, Tensor, Tensor, int]:
    """Return (nodes int64, occupancies uint8 of all levels, nodes of each level and at the end [levels + 1], status).

    counts  [levels, 4, 255] int64, none empty
    points  no level has more nodes
    """
    nodes = counts.new_empty(points)
    occupancies, sizes = words.new_empty(len(counts) * points), counts.new_zeros(len(counts) + 1)
    call = face.decode_octree(
        words=words, counts=counts, points=points, nodes=nodes, occupancies=occupancies, sizes=sizes
    )
    return nodes, occupancies, sizes, call.status


def decode_bits(words: Tensor, zeros: int, count: int) -> tuple[Tensor, int]:
    """Return (bits [count] int32, status); `zeros` of 2^24 is the share of 0."""
    bits = words.new_empty(count, dtype=torch.int32)
    return bits, face.decode_bits(words=words, zeros=zeros, bits=bits).status


class RangeSession:
    """Symbols of several models from one stream of range-coded words, each call behind the one before.

    words   uint8, whole 32-bit words, little-endian
    """

    def __init__(self, words: Tensor) -> None:
        self._words = words
        first = int.from_bytes(words[:4].numpy().tobytes(), "little")
        second = int.from_bytes(words[4:8].numpy().tobytes(), "little")
        point = first << 32 | second
        read = min(len(words) // 4, 2)
        self._state = torch.tensor([0, -1, point - (point >> 63 << 64), read])  # low, range, point, words read

    def bits(self, zeros: Tensor) -> tuple[Tensor, int]:
        """Return (bits bool [n], status) under shares int32 [n] of 0, of 2^24."""
        bits = torch.empty(len(zeros), dtype=torch.bool)
        return bits, face.range_bits(words=self._words, state=self._state, zeros=zeros, bits=bits).status

    def entries(self, tables: Sequence[Tensor], number: Tensor) -> tuple[Tensor, int]:
        """Return (entries int32 [n], status) under table `number` int16 [n] each, coded table by table."""
        entries = torch.empty(len(number), dtype=torch.int32)
        call = face.range_entries(
            **_named(tables), words=self._words, state=self._state, number=number, entries=entries
        )
        return entries, call.status

    def choices(self, counts: Tensor) -> tuple[Tensor, int]:
        """Return (int32 [n] in 0..2, status) under counts float64 [n,3]."""
        entries = torch.empty(len(counts), dtype=torch.int32)
        return entries, face.range_choices(words=self._words, state=self._state, counts=counts, entries=entries).status

    def leaf_octree(self, zeros: Tensor, rows: int, known: Sequence[Tensor]) -> tuple[Tensor, Tensor, int]:
        """Return (levels, Morton codes int64 [rows], status) of a subset of splats.

        zeros   [16 * 185] int32 shares of 0 by level and context
        known   [17] int64 where the cells of each level begin; the cells, ascending; splats in each
        """
        start, cells, counts = known
        levels, codes = torch.empty(rows, dtype=torch.int64), torch.empty(rows, dtype=torch.int64)
        call = face.decode_leaf_octree(
            words=self._words, state=self._state, zeros=zeros, known_start=start, known_cells=cells,
            known_counts=counts, levels=levels, codes=codes,
        )  # fmt: skip
        return levels, codes, call.status

    @property
    def is_used_up(self) -> bool:
        """Whether the last word was read and what is left of it needs no further symbol."""
        low, _, point, read = self._state.tolist()
        return bool(read == len(self._words) // 4 and (point - low) % (1 << 64) < 1 << 33)


def network(inputs: Sequence[Tensor], weights: Tensor, widths: Tensor, leak: int, outputs: Tensor) -> None:
    """Write outputs [n, out] int64 of a network on one or two inputs side by side.

    inputs  [n, in] int16, or int64 each
    weights [P] float64 of all layers in turn, W [out, in] and b [out]
    widths  [layers + 1] int64, of inputs and outputs
    leak    slope of activations below 0, in 1/4096
    """
    face.network(**_inputs(inputs), weights=weights, widths=widths, leak=leak, outputs=outputs)


def forecast(
    inputs: Sequence[Tensor], weights: Tensor, widths: Tensor, multipliers: Tensor, thresholds: Tensor,
    centre: Sequence[Tensor], number: Sequence[Tensor], steps: Tensor,
) -> int:  # fmt: skip
    """Write centre int32 and number int16 [n,C] of each group and steps [n, groups] int64; return the status."""
    columns = [each.shape[1] for each in centre]
    if any(
        a.shape != (len(steps), c) or b.shape != a.shape for a, b, c in zip(centre, number, columns, strict=True)
    ) or len(columns) != steps.shape[1]:  # fmt: skip
        raise RuntimeError("forecast: centre and number must be [rows, columns] of each group")
    call = face.forecast(
        **_inputs(inputs), weights=weights, widths=widths, multipliers=multipliers, thresholds=thresholds,
        centre=centre, number=number, group_columns=columns, steps=steps,
    )  # fmt: skip
    return int(call.status)


def grid_features(
    codes: Tensor, axes: Sequence[int], signs: Tensor, features: int, levels: Tensor, dense: int, log2_size: int,
    found: Tensor,
) -> None:  # fmt: skip
    """Write the columns of a grid into `found` [n, width] int64 or int16.

    signs   [entries] int16: bit f is sign f
    levels  [3, L] int64: resolution - 1, first entry and first column; dense levels first
    """
    into = "short_found" if found.dtype == torch.int16 else "found"
    face.grid_features(
        codes=codes, axes=axes, dimensions=len(axes), signs=signs, features=features, levels=levels, dense=dense,
        log2_size=log2_size, **{into: found},
    )  # fmt: skip


def triplane_features(places: Tensor, planes: Sequence[Tensor], sizes: Sequence[int]) -> Tensor:
    """Return [n, scales * 3 * C] int64 of places [n,3] int64 and planes [3, R * R, C] int32 of each scale."""
    channels = planes[0].shape[2]
    if [p.shape for p in planes] != [(3, size * size, channels) for size in sizes]:
        raise RuntimeError("triplane_features: planes must be [3, R * R, C]")
    found = places.new_empty(len(places), len(planes) * 3 * channels)
    face.triplane_features(
        places=places, planes=planes, sizes=sizes, scales=len(planes), channels=channels, found=found
    )
    return found


def decode_mixtures(tables: Sequence[Tensor], rows: Sequence[Tensor], words: Tensor) -> tuple[Tensor, int]:
    """Return (entries [n] int32, status) of range-coded words.

    tables  below, escape, first, radius; rows: order, width, shift, number, weight (exact_kernels/mixtures.h)
    """
    entries = torch.empty_like(rows[0])
    call = face.decode_mixtures(**_mixtures(tables, rows), words=words, entries=entries)
    return entries, call.status


def encode_mixtures(tables: Sequence[Tensor], rows: Sequence[Tensor], entries: Tensor) -> Tensor:
    """Return range-coded words, uint8, of entries [n] int32."""
    words = entries.new_empty(4 * (len(entries) + 2), dtype=torch.uint8)
    return words[: face.encode_mixtures(**_mixtures(tables, rows), entries=entries, words=words).written]


def mixture_rows(
    parts: Sequence[Tensor], multipliers: Tensor, thresholds: Tensor, radius: Tensor, half_widths: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, int]:
    """Return (centre, half-width, order [m], shift, number [m,2], weight [m], status) of rows of numbers.

    parts   mean, scale, second mean, second scale, logit [n,C] and step [n,1] int64

    All are int32 but the number, which is int16.
    """
    *five, step = parts
    rows, columns = five[0].shape
    m = rows * columns
    centre, width, order, weight = (radius.new_empty(m) for _ in range(4))
    shift, number = radius.new_empty(m, 2), radius.new_empty(m, 2, dtype=torch.int16)
    call = face.mixture_rows(
        parts=five, strides=[_gapless(each) for each in five], step=step, step_stride=_gapless(step), rows=rows,
        columns=columns, multipliers=multipliers, thresholds=thresholds, radius=radius, half_widths=half_widths,
        centre=centre, width=width, order=order, shift=shift, number=number, weight=weight,
    )  # fmt: skip
    return centre, width, order, shift, number, weight, call.status


def _counted(present: Tensor | None, like: Tensor) -> tuple[int, Tensor | None]:
    """Count of the present numbers, and scratch for the starts of rows."""
    if present is None:
        return like.numel(), None
    return int(torch.count_nonzero(present)), _scratch(len(like))


def _gapless(rows: Tensor) -> int:
    """The distance of rows [n,C], of which each must lie in one piece."""
    if rows.dim() != 2 or (rows.shape[1] > 1 and rows.stride(1) != 1):
        raise RuntimeError(f"rows must lie in one piece, not with strides {rows.stride()}")
    return rows.stride(0)


def _scratch(count: int) -> Tensor:
    return torch.empty(count, dtype=torch.int64)


def _room(symbols: int, streams: int) -> Tensor:
    """Room for whatever streams of so many symbols become (most_bytes in exact_kernels/kernels.h)."""
    return torch.empty(11 * symbols + 20 * streams, dtype=torch.uint8)


def _named(tables: Sequence[Tensor]) -> dict[str, Any]:
    return dict(zip(("shares", "first", "radius", "bucket"), tables, strict=True))


def _mixtures(tables: Sequence[Tensor], rows: Sequence[Tensor]) -> dict[str, Any]:
    names = ("below", "escape", "first", "radius", "order", "half_width", "shift", "number", "weight")
    return dict(zip(names, (*tables, *rows), strict=True))


def _planes(planes: Sequence[Tensor], weights: Tensor) -> dict[str, Any]:
    if any(plane.dim() != 4 or len(plane) != len(weights) for plane in planes):
        raise RuntimeError("planes must be [orientations, channels, height, width]")
    _, channels, height, width = zip(*(plane.shape for plane in planes), strict=True)
    return {"planes": planes, "channels": channels, "height": height, "width": width, "scales": len(planes)}


def _inputs(inputs: Sequence[Tensor]) -> dict[str, Any]:
    if len(inputs) == 1 and inputs[0].dtype == torch.int16:
        return {"short_inputs": inputs[0], "stride": 0, "further_stride": 0}
    first, further = inputs if len(inputs) == 2 else (inputs[0], None)
    return {
        "inputs": first, "stride": _gapless(first), "further": further,
        "further_stride": 0 if further is None else _gapless(further),
    }  # fmt: skip
