"""The codec `gaussians-tiles`: the whole scene coarsely, then place by place as it is.

Packet 1 has the Gaussians that weigh most in pictures, and few *stand-ins*, merged from all others. Each later one is
a group of a *tile*, a run of the scene along the Morton curve: the next of its Gaussians by weight, and stand-ins of
those that are still to come, which take the place of the tile's earlier ones. With all packets no stand-in is left, and
what is decoded is what `gaussians-quantized` keeps at the same steps. What removes most error for its size comes first,
as measured in pictures from cameras that are made up.
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
from sw_codecs.models.band_context import suitable_classes
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
HEAVIEST = 0.02
"""Share of the Gaussians that packet 1 has as they are."""
GROWTH = 0.45
"""Share of the Gaussians after a layer of those after the next."""

Rows = Annotated[int, Field(ge=0, lt=2**32)]
Group = tuple[Annotated[int, Field(ge=0, lt=MOST_GROUPS)], Rows, Rows]
"""Tile, Gaussians that stay, and stand-ins until the tile's next group."""


class TiledLayout(Layout):
    """Header values of a file in tiles.

    first   Gaussians of packet 1 that stay
    base    its stand-ins in each tile
    groups  of packets 2, 3, ...
    """

    packets: None = None
    precision: None = None
    sh_basis: None = None
    first: Rows
    base: list[Rows] = Field(max_length=MOST_GROUPS)
    groups: list[Group] = Field(max_length=MOST_GROUPS)


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
    scene, n = reconstruct(found), found.layout.num_gaussians
    worth = Worth(scene, writer.raster, plugins)
    weights = worth.weights(scene)
    layer_of = _layers(weights, settings)
    stages = []
    for layer in range(settings.layers if n else 0):
        left = np.flatnonzero(layer_of > layer)
        share = settings.stand_ins if layer else settings.coarsest
        coarse = _stand_ins(select(scene, torch.from_numpy(left)), weights[left], math.ceil(n / share))
        stages.append(_lattice(coarse, settings, positions, found.layout.grid))
    tiles = _Tiles(found.cells, settings)
    groups = _ordered(found, layer_of, stages, tiles, worth)
    first = np.flatnonzero(layer_of == 0)
    told = TiledLayout(
        **found.layout.model_dump(exclude={"packets", "precision", "sh_basis", "sh_classes"}),
        sh_classes=suitable_classes(n // max(len(groups), 1)),
        first=len(first),
        base=tiles.counts(stages[0].cells) if stages else [],
        groups=[(group.tile, len(group.rows), len(group.stand_ins)) for group in groups],
    )
    writer.raster["sh_degree"] = told.max_sh_degree
    writer.static.update(told.model_dump(mode="json", exclude_none=True))
    settings.state(writer)
    columns = plugins.entropy_models.load(settings.entropy)()

    def add(number: int, rows: NDArray[np.int64], stand_ins: Lattice | None) -> None:
        encode_rows(replace(found.part(rows), layout=told), f"{number}/", writer, positions, columns)
        if stand_ins is not None and len(stand_ins.cells):
            encode_rows(replace(stand_ins, layout=told), f"{number}/{STAND_INS}", writer, positions, columns)
        writer.cut()

    add(1, first, stages[0] if stages else None)
    for number, group in enumerate(groups, 2):
        is_last = group.layer == len(stages)
        add(number, group.rows, None if is_last else stages[group.layer].part(group.stand_ins))
    writer.allow(told.decoded_bytes, f"a model of {n:,} Gaussians")


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
        self.count = min(math.ceil(n / settings.rows), MOST_GROUPS // settings.layers)
        self._first = morton.encode(cells[np.arange(self.count) * n // max(self.count, 1)])

    def of(self, cells: NDArray[np.int64]) -> NDArray[np.int64]:
        """The tile of each cell [N], ascending along the curve."""
        return np.maximum(np.searchsorted(self._first, morton.encode(cells), side="right") - 1, 0)

    def counts(self, cells: NDArray[np.int64]) -> list[int]:
        return [int(count) for count in np.bincount(self.of(cells), minlength=self.count)]


@dataclass
class _Group:
    """Rows of the scene, and of the stand-ins of its layer."""

    tile: int
    layer: int
    rows: NDArray[np.int64]
    stand_ins: NDArray[np.int64]


def _ordered(
    found: Lattice, layer_of: NDArray[np.int64], stages: list[Lattice], tiles: _Tiles, worth: Worth
) -> list[_Group]:
    """Groups of all tiles in the order of the file: what removes most error for its size comes first."""
    tile_of = tiles.of(found.cells)
    known = [tiles.of(stage.cells) for stage in stages]
    errors = []
    for layer, stage in enumerate(stages):
        there = np.flatnonzero(layer_of <= layer)
        by_row = worth.errors(_joined(found.part(there), stage))
        rows = np.concatenate([tile_of[there], known[layer]])
        errors.append(np.bincount(rows, by_row, minlength=tiles.count))
    none = np.empty(0, dtype=np.int64)
    ranked: list[tuple[float, int, _Group]] = []
    for tile in range(tiles.count):
        error = errors[0][tile]
        least = math.inf
        for layer in range(1, len(stages) + 1):
            is_last = layer == len(stages)
            rows = np.flatnonzero((layer_of == layer) & (tile_of == tile))
            if not len(rows) and not is_last:
                continue
            stand_ins = none if is_last else np.flatnonzero(known[layer] == tile)
            now = 0.0 if is_last else errors[layer][tile]
            least = min(least, (error - now) / max(len(rows) + len(stand_ins), 1))
            error = now
            ranked.append((-least, len(ranked), _Group(tile, layer, rows, stand_ins)))
    return [group for _, _, group in sorted(ranked, key=lambda each: each[:2])]


def _joined(one: Lattice, other: Lattice) -> GaussianModel:
    both = replace(one, cells=np.concatenate([one.cells, other.cells]),
                   symbols=np.concatenate([one.symbols, other.symbols]))  # fmt: skip
    return reconstruct(replace(both, layout=one.layout.model_copy(update={"num_gaussians": len(both.cells)})))


def decode(reader: ContainerReader, plugins: PluginManager) -> GaussianModel:
    """The model of the packets that are there, each tile with the stand-ins of its last group. BitstreamError."""
    layout = parsed(reader, TiledLayout)
    _check(layout, reader)
    groups = layout.groups[: reader.packets - 1]
    last = {tile: number for number, (tile, _, _) in enumerate(groups)}
    runs: list[tuple[str, int, bool | list[bool]]] = [
        ("1/", layout.first, True),
        (f"1/{STAND_INS}", sum(layout.base), [tile not in last for tile in range(len(layout.base))]),
    ]
    for number, (tile, rows, stand_ins) in enumerate(groups):
        runs += [(f"{number + 2}/", rows, True), (f"{number + 2}/{STAND_INS}", stand_ins, last[tile] == number)]
    n = sum(rows for _, rows, _ in runs)
    there = layout.model_copy(update={"num_gaussians": n})
    reader.allow(there.decoded_bytes, f"a model of {n:,} Gaussians")
    columns = layout.base_columns + layout.rest_columns
    found = Lattice(there, np.empty((n, 3), dtype=np.int64), np.empty((n, columns), dtype=np.int32))
    keep = np.empty(n, dtype=bool)
    end = 0
    for prefix, rows, shown in runs:
        start, end = end, end + rows
        keep[start:end] = np.repeat(shown, layout.base) if isinstance(shown, list) else shown
        if rows or not prefix.endswith(STAND_INS):
            decode_rows(found.part(slice(start, end)), prefix, reader, plugins)
    left = layout.model_copy(update={"num_gaussians": int(keep.sum())})
    return finite(reconstruct(replace(found.part(np.flatnonzero(keep)), layout=left)), reader)


def _check(layout: TiledLayout, reader: ContainerReader) -> None:
    """Raise BitstreamError unless cuts, tiles and groups make one scene."""
    last = {tile: stand_ins for tile, _, stand_ins in layout.groups}
    fits = (
        len(reader.cuts) == 1 + len(layout.groups)
        and layout.first + sum(rows for _, rows, _ in layout.groups) == layout.num_gaussians
        and sorted(last) == list(range(len(layout.base)))
        and not any(last.values())
        and layout.primitive is None
    )
    if not fits:
        raise BitstreamError(f"{reader.name}: cuts, tiles and their Gaussians do not fit together", section="header")
