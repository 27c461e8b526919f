"""The codec `gaussians-tiles`: the whole scene coarsely, then place by place, then as exactly as it is.

Packet 1 has the Gaussians that weigh most in pictures, and few *stand-ins*, merged from all others. A later one is
a group of a *tile*, a run of the scene along the Morton curve: the next of its Gaussians by weight, and stand-ins of
those that are still to come, which take the place of the tile's earlier ones. All these are rounded to steps some times
as wide as the scene's; another kind of packet, *finer*, has what the Gaussians of an earlier one lack. With all packets
no stand-in is left, and what is decoded is what `gaussians-quantized` keeps at the same steps. What removes most error
for its size comes first, as measured in pictures from cameras that are made up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from sw_gaussians.rows import select
from sw_gaussians.simplifying import merged_to

from splatwizard_core.api import BitstreamError, GaussianModel, ShapeError
from sw_codecs.models.attributes import MAX_SYMBOL
from sw_codecs.models.band_context import decode_matrix, suitable_classes
from sw_codecs.models.exchangeable import entropy_model
from sw_codecs.models.quantized import (
    FAINTEST,
    Lattice,
    Layout,
    decode_rows,
    encode_rows,
    finite,
    parsed,
    reconstruct,
    rounded,
    unrounded,
)
from sw_codecs.positions import morton
from sw_lod.settings import TileSettings
from sw_lod.worth import Worth

if TYPE_CHECKING:
    from splatwizard_core.api import ContainerReader, ContainerWriter, PluginManager, PositionCodec
    from sw_codecs.models.position_grid import PositionGrid

MOST_GROUPS = 255
"""With packet 1 256 packets of at most sixteen sections, all that a file can have."""
STAND_INS = "stand-ins/"
FINER = "finer"
HEAVIEST = 0.04
"""Share of the Gaussians that packet 1 has as they are."""
GROWTH = 0.42
"""Share of the Gaussians after a layer of those after the next."""
STAND_IN_SIZE = 0.5
"""Bytes of a stand-in, of those of a coarse Gaussian, about."""

Rows = Annotated[int, Field(ge=0, lt=2**32)]
Group = tuple[Annotated[int, Field(ge=0, lt=MOST_GROUPS)], Rows, Rows]
"""Tile, Gaussians that stay, and stand-ins until the tile's next group."""
Finer = tuple[Annotated[int, Field(ge=2, le=MOST_GROUPS + 1)], Annotated[int, Field(ge=1, le=MOST_GROUPS)]]
"""A packet, and the one whose Gaussians it makes finer."""


class TiledLayout(Layout):
    """Header values of a file in tiles.

    first   Gaussians of packet 1 that stay
    base    its stand-ins in each tile
    groups  of packets 2, 3, ... but those of `finer`
    times   quantiser steps of Gaussians that are still coarse, in steps of the file; odd
    raw     bits of their positions' coordinates that are missing
    """

    packets: None = None
    precision: None = None
    sh_basis: None = None
    first: Rows
    base: list[Rows] = Field(max_length=MOST_GROUPS)
    groups: list[Group] = Field(max_length=MOST_GROUPS)
    finer: list[Finer] = Field([], max_length=MOST_GROUPS)
    times: int = Field(1, ge=1, le=255)
    raw: int = Field(0, ge=0, le=12)

    @property
    def coarse(self) -> TiledLayout:
        """The layout by which rows of packets are coded."""
        return self.model_copy(update={"position_bits": self.position_bits - self.raw})


class Tiles:
    """Coarse first, then place by place; the file may end after any packet."""

    Settings = TileSettings

    def __init__(self, plugins: PluginManager, **settings: Any) -> None:
        self.plugins, self.settings = plugins, TileSettings(**settings)
        self.settings.check(plugins)

    def encode(self, model: GaussianModel, writer: ContainerWriter) -> None:
        encode(model, writer, self.settings, self.plugins)

    def decode(self, reader: ContainerReader) -> GaussianModel:
        return decode(reader, self.plugins)


def encode(model: GaussianModel, writer: ContainerWriter, settings: TileSettings, plugins: PluginManager) -> None:
    """Sections positions, color, ... of each packet as 1/positions, 1/stand-ins/positions and so on.

    Raises ShapeError for surfels.
    """
    if model.NUM_SCALES != GaussianModel.NUM_SCALES:
        raise ShapeError("surfels cannot be merged: an average of flat ones has a thickness")
    positions = plugins.position_codecs.load(settings.positions)()
    found = _lattice(_drawn(model), settings, positions)
    found = found.part(positions.sort(found.cells >> settings.raw))
    scene, n = reconstruct(found), found.layout.num_gaussians
    worth = Worth(scene, writer.raster, plugins)
    weights = worth.weights(scene)
    layer_of = _layers(weights, settings)
    stages = []
    for layer in range(settings.layers if n else 0):
        left = np.flatnonzero(layer_of > layer)
        share = settings.stand_ins if layer else settings.coarsest
        merged = _stand_ins(select(scene, torch.from_numpy(left)), weights[left], math.ceil(n / share))
        stage = _lattice(merged, settings, positions, found.layout.grid)
        stages.append(stage.part(positions.sort(stage.cells >> settings.raw)))
    tiles = _Tiles(found.cells, settings)
    packets = _ordered(found, layer_of, stages, tiles, worth, settings)
    groups = [packet for packet in packets if not packet.is_finer]
    numbers = {(packet.tile, packet.layer): number for number, packet in enumerate(packets, 1) if not packet.is_finer}
    told = TiledLayout(
        **found.layout.model_dump(exclude={"packets", "precision", "sh_basis", "sh_classes"}),
        sh_classes=suitable_classes(n // max(len(groups), 1)),
        first=len(packets[0].rows),
        base=tiles.counts(stages[0].cells) if stages else [],
        groups=[(group.tile, len(group.rows), len(group.stand_ins)) for group in groups[1:]],
        finer=[
            (number, numbers[packet.tile, packet.layer]) for number, packet in enumerate(packets, 1) if packet.is_finer
        ],
        times=settings.times,
        raw=settings.raw,
    )
    writer.raster["sh_degree"] = told.max_sh_degree
    writer.static.update(told.model_dump(mode="json", exclude_none=True))
    settings.state(writer)
    columns = plugins.entropy_models.load(settings.entropy)()
    for number, packet in enumerate(packets, 1):
        part = found.part(packet.rows)
        if packet.is_finer:
            writer.add(f"{number}/{FINER}", columns.encode(_lacking(part, told), None))
        else:
            encode_rows(_coarse(part, told), f"{number}/", writer, positions, columns)
            if len(packet.stand_ins):
                stand_ins = stages[packet.layer].part(packet.stand_ins)
                encode_rows(_coarse(stand_ins, told), f"{number}/{STAND_INS}", writer, positions, columns)
        writer.cut()
    writer.allow(told.decoded_bytes, f"a model of {n:,} Gaussians")


def _coarse(found: Lattice, layout: TiledLayout) -> Lattice:
    """The rows at steps `times` as wide, at the nearest of these."""
    symbols = (found.symbols + layout.times // 2) // layout.times
    return replace(found, layout=layout.coarse, cells=found.cells >> layout.raw, symbols=symbols)


def _lacking(found: Lattice, layout: TiledLayout) -> NDArray[np.int32]:
    """Integers [N,3+C] that the rows lack once they are coarse: low bits of the cells, and symbols."""
    coarse = _coarse(found, layout)
    bits = found.cells - (coarse.cells << layout.raw)
    return np.concatenate([bits.astype(np.int32), found.symbols - layout.times * coarse.symbols], axis=1)


def _refine(found: Lattice, layout: TiledLayout, lacking: NDArray[np.int32] | None) -> None:
    """Put what the rows stand for in place of coarse ones; without `lacking` in the middle of what they may be."""
    found.cells[:] <<= layout.raw
    found.symbols[:] *= layout.times
    if lacking is None:
        found.cells[:] += (1 << layout.raw) >> 1
    else:
        found.cells[:] += lacking[:, :3]
        found.symbols[:] += lacking[:, 3:]


def _lattice(
    model: GaussianModel, settings: TileSettings, positions: PositionCodec, grid: PositionGrid | None = None
) -> Lattice:
    return rounded(unrounded(model, precision_power=0, own_basis=False), settings, positions.sort, grid)


def _drawn(model: GaussianModel) -> GaussianModel:
    """The Gaussians that can be seen, on the CPU: those that the lattice keeps."""
    raw = {name: getattr(model, name).detach().cpu() for name in model.RAW}
    keep = raw["opacity_logits"] >= FAINTEST
    for name, values in raw.items():
        flat = values.flatten(1) if values.dim() > 1 else values[:, None]
        keep &= (~flat.isnan() if name == "opacity_logits" else flat.isfinite()).all(dim=1)
    kept = {name: values[keep] for name, values in raw.items()}
    return type(model)(**kept, active_sh_degree=model.active_sh_degree)


def _stand_ins(model: GaussianModel, weights: NDArray[np.float64], count: int) -> GaussianModel:
    """So many in place of Gaussians, seen alike from all sides: other bands would cost more than they bring."""
    found = merged_to(model, count, significance=torch.from_numpy(weights**0.5), widen=True)
    found.sh_rest.zero_()
    return found


def _layers(weights: NDArray[np.float64], settings: TileSettings) -> NDArray[np.int64]:
    """Layer [N] of each row: 0 for packet 1, which has the heaviest, then by weight; the last one ends with all."""
    n = len(weights)
    ends = [round(HEAVIEST * n), *(round(n * GROWTH**left) for left in range(settings.layers - 1, -1, -1))]
    ranks = np.empty(n, dtype=np.int64)
    ranks[np.argsort(-weights, kind="stable")] = np.arange(n)
    found: NDArray[np.int64] = np.searchsorted(ends, ranks, side="right")
    return found


class _Tiles:
    """Runs of nearly equal length along the Morton curve."""

    def __init__(self, cells: NDArray[np.int64], settings: TileSettings) -> None:
        n = len(cells)
        # Besides the groups there are packet 1, and one that makes each of these finer.
        most = (MOST_GROUPS - 1) // 2 if settings.is_layered else MOST_GROUPS
        self.count = min(math.ceil(n / settings.rows), most // settings.layers)
        self._first = morton.encode(cells[np.arange(self.count) * n // max(self.count, 1)])

    def of(self, cells: NDArray[np.int64]) -> NDArray[np.int64]:
        """The tile of each cell [N], ascending along the curve."""
        return np.maximum(np.searchsorted(self._first, morton.encode(cells), side="right") - 1, 0)

    def counts(self, cells: NDArray[np.int64]) -> list[int]:
        return [int(count) for count in np.bincount(self.of(cells), minlength=self.count)]


@dataclass
class _Packet:
    """Rows of the scene that become finer; or, coarse, and stand-ins of their layer until the tile's next layer comes.

    tile    -1 of packet 1, which has rows of all
    """

    tile: int
    layer: int
    rows: NDArray[np.int64]
    stand_ins: NDArray[np.int64]
    is_finer: bool = False


def _ordered(
    found: Lattice, layer_of: NDArray[np.int64], stages: list[Lattice], tiles: _Tiles, worth: Worth,
    settings: TileSettings,
) -> list[_Packet]:  # fmt: skip
    """Packets in the order of the file: packet 1, then what removes most error for its size."""
    none = np.empty(0, dtype=np.int64)
    tile_of = tiles.of(found.cells)
    known = [tiles.of(stage.cells) for stage in stages]
    errors = []
    for layer, stage in enumerate(stages):
        there = np.flatnonzero(layer_of <= layer)
        by_row = worth.errors(_shown(_joined(found.part(there), stage), settings))
        rows = np.concatenate([tile_of[there], known[layer]])
        errors.append(np.bincount(rows, by_row, minlength=tiles.count))
    coarse = np.zeros(len(tile_of))
    if settings.is_layered and len(coarse):
        coarse = worth.errors(_shown(found, settings))
    errors.append(np.bincount(tile_of, coarse, minlength=tiles.count))
    base = np.arange(len(stages[0].cells)) if stages else none
    ranked = [(math.inf, _Packet(-1, 0, np.flatnonzero(layer_of == 0), base))]
    for tile in range(tiles.count):
        error = errors[0][tile]
        gains, sizes, packets = [], [], []
        for layer in range(1, len(stages) + 1):
            is_last = layer == len(stages)
            rows = np.flatnonzero((layer_of == layer) & (tile_of == tile))
            if not len(rows) and not is_last:
                continue
            stand_ins = none if is_last else np.flatnonzero(known[layer] == tile)
            gains.append(error - errors[layer][tile])
            sizes.append(max(len(rows) + STAND_IN_SIZE * len(stand_ins), 1))
            packets.append(_Packet(tile, layer, rows, stand_ins))
            error = errors[layer][tile]
        ranked += zip(_worths(gains, sizes), packets, strict=True)
    ranked.sort(key=lambda each: -each[0])
    found_packets = [packet for _, packet in ranked]
    if not settings.is_layered:
        return found_packets
    # What is left of the error once all Gaussians are there says little about what they lack before.
    finer = [replace(packet, stand_ins=none, is_finer=True) for packet in found_packets if len(packet.rows)]
    return found_packets + sorted(finer, key=lambda packet: -coarse[packet.rows].mean())


def _worths(gains: list[float], sizes: list[float]) -> list[float]:
    """Gain for its size of each step of a chain, never below that of a later one: steps that pay only together have
    their mean."""
    runs: list[tuple[float, float, int]] = []
    for gain, size in zip(gains, sizes, strict=True):
        run = (gain, size, 1)
        while runs and run[0] * runs[-1][1] > runs[-1][0] * run[1]:
            before = runs.pop()
            run = (run[0] + before[0], run[1] + before[1], run[2] + before[2])
        runs.append(run)
    return [gain / size for gain, size, steps in runs for _ in range(steps)]


def _joined(one: Lattice, other: Lattice) -> Lattice:
    return replace(one, cells=np.concatenate([one.cells, other.cells]),
                   symbols=np.concatenate([one.symbols, other.symbols]))  # fmt: skip


def _shown(found: Lattice, settings: TileSettings) -> GaussianModel:
    """Rows as they show while they are coarse."""
    layout = found.layout.model_copy(update={"num_gaussians": len(found.cells)})
    told = TiledLayout(**layout.model_dump(exclude={"packets", "precision", "sh_basis"}), first=0, base=[], groups=[],
                       times=settings.times, raw=settings.raw)  # fmt: skip
    coarse = _coarse(found, told)
    _refine(coarse, told, None)
    return reconstruct(replace(coarse, layout=layout))


def decode(reader: ContainerReader, plugins: PluginManager) -> GaussianModel:
    """The model of the packets that are there, each tile with the stand-ins of its last group. BitstreamError."""
    layout = parsed(reader, TiledLayout)
    _check(layout, reader)
    of_finer = {packet: source for packet, source in layout.finer if packet <= reader.packets}
    numbers = [number for number in range(2, reader.packets + 1) if number not in of_finer]
    groups = list(zip(numbers, layout.groups, strict=False))
    last = {tile: number for number, (tile, _, _) in groups}
    runs: list[tuple[int, str, int, bool | list[bool]]] = [
        (1, "", layout.first, True),
        (1, STAND_INS, sum(layout.base), [tile not in last for tile in range(len(layout.base))]),
    ]
    for number, (tile, rows, stand_ins) in groups:
        runs += [(number, "", rows, True), (number, STAND_INS, stand_ins, last[tile] == number)]
    n = sum(rows for _, _, rows, _ in runs)
    there = layout.model_copy(update={"num_gaussians": n})
    reader.allow(there.decoded_bytes, f"a model of {n:,} Gaussians")
    columns = layout.base_columns + layout.rest_columns
    found = Lattice(there.coarse, np.empty((n, 3), dtype=np.int64), np.empty((n, columns), dtype=np.int32))
    keep = np.empty(n, dtype=bool)
    packet_of = {source: packet for packet, source in of_finer.items()}
    end = 0
    for number, kind, rows, shown in runs:
        start, end = end, end + rows
        keep[start:end] = np.repeat(shown, layout.base) if isinstance(shown, list) else shown
        if not rows and kind:
            continue
        part = found.part(slice(start, end))
        lacking = (
            None if kind or number not in packet_of else _read_lacking(packet_of[number], part, layout, reader, plugins)
        )
        decode_rows(part, f"{number}/{kind}", reader, plugins)
        if len(part.symbols) and int(np.abs(part.symbols).max()) > MAX_SYMBOL // layout.times:
            raise BitstreamError(f"{reader.name}: a coarse value of packet {number} is beyond 2^30", section="header")
        _refine(part, layout, lacking)
    left = layout.model_copy(update={"num_gaussians": int(keep.sum())})
    return finite(reconstruct(replace(found.part(np.flatnonzero(keep)), layout=left)), reader)


def _read_lacking(
    number: int, part: Lattice, layout: TiledLayout, reader: ContainerReader, plugins: PluginManager
) -> NDArray[np.int32]:
    """The part of these rows that the packet of this number has."""
    rows, width = part.symbols.shape
    with reader.decoding(f"{number}/{FINER}") as data:
        found = decode_matrix(entropy_model(reader, plugins), data, rows, 3 + width)
        bits, symbols = found[:, :3], found[:, 3:]
        if rows and not (0 <= int(bits.min()) <= int(bits.max()) < 1 << layout.raw):
            raise BitstreamError(f"a coordinate has more than {layout.raw} bits")
        if rows and int(np.abs(symbols).max()) > layout.times // 2:
            raise BitstreamError(f"a value is beyond {layout.times // 2}")
    return found.astype(np.int32)


def _check(layout: TiledLayout, reader: ContainerReader) -> None:
    """Raise BitstreamError unless cuts, tiles and groups make one scene."""
    last = {tile: stand_ins for tile, _, stand_ins in layout.groups}
    packets = len(layout.groups) + len(layout.finer) + 1
    finer = dict(layout.finer)
    fits = (
        len(reader.cuts) == packets
        and layout.first + sum(rows for _, rows, _ in layout.groups) == layout.num_gaussians
        and sorted(last) == list(range(len(layout.base)))
        and not any(last.values())
        and layout.primitive is None
        and layout.times % 2 == 1
        and layout.raw < layout.position_bits
        and len(finer) == len(set(finer.values())) == len(layout.finer)
        and all(source < packet <= packets and source not in finer for packet, source in layout.finer)
    )
    if not fits:
        raise BitstreamError(f"{reader.name}: cuts, tiles and their Gaussians do not fit together", section="header")
