"""The codec `gaussians-tiles`: the whole scene coarsely, then place by place as it is.

Packet 1 is the *base*, the scene merged to few Gaussians. Each later one is a group of Gaussians of a *tile*, a run of
the scene along the Morton curve, the most significant first. The first group of a tile takes the place of the base
there; until the last one has come the tile's Gaussians are swollen over the gaps. With all packets nothing is left of
the base, and what is decoded is what `gaussians-quantized` keeps at the same steps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from sw_gaussians.simplifying import merged_to

from splatwizard_core.api import BitstreamError, GaussianModel
from sw_codecs.models.band_context import suitable_classes
from sw_codecs.models.quantized import (
    FAINTEST,
    Lattice,
    Layout,
    coverage,
    decode_rows,
    encode_rows,
    finite,
    parsed,
    reconstruct,
    rounded,
    significant_first,
    unrounded,
)
from sw_codecs.positions import morton
from sw_lod.settings import TileSettings

if TYPE_CHECKING:
    from splatwizard_core.api import ContainerReader, ContainerWriter, PluginManager, PositionCodec
    from sw_codecs.models.position_grid import PositionGrid

SMALLEST_PREFIX = 1 / 4
"""Of a tile, as for `significant_first`: with fewer Gaussians than that it looks worse than the base."""
MOST_TILES = 256
MOST_GROUPS = 511
"""With the base 512 packets of eight sections, all that a file can have."""

Rows = Annotated[int, Field(ge=0, lt=2**32)]
Group = tuple[Annotated[int, Field(ge=0, lt=MOST_TILES)], Rows, Annotated[float, Field(ge=0, le=10)]]
"""Tile, rows, and what is added to the tile's log scales while this is the last of its groups that is there."""


class TiledLayout(Layout):
    """Header values of a file in tiles.

    base    rows of packet 1 that lie in each tile
    groups  of packets 2, 3, ...
    """

    packets: None = None
    precision: None = None
    sh_basis: None = None
    base: list[Rows] = Field(max_length=MOST_TILES)
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
    """Sections positions, color, ... of each packet as 1/positions and so on. Raises ShapeError for surfels."""
    positions = plugins.position_codecs.load(settings.positions)()
    drawn = _drawn(model)
    found = _lattice(drawn, settings, positions)
    n = found.layout.num_gaussians
    coarse = merged_to(drawn, math.ceil(n / settings.coarsest)) if n else drawn
    base = _lattice(coarse, settings, positions, found.layout.grid)
    tiles = _tiles(found.cells, base.cells, settings.rows)
    groups = _groups(found, tiles, settings.layers)
    told = TiledLayout(
        **found.layout.model_dump(exclude={"packets", "precision", "sh_basis", "sh_classes"}),
        sh_classes=suitable_classes(n // max(len(groups), 1)),
        base=[tile.base for tile in tiles],
        groups=[(group.tile, len(group.rows), group.swell) for group in groups],
    )
    writer.raster["sh_degree"] = told.max_sh_degree
    writer.static.update(told.model_dump(mode="json", exclude_none=True))
    settings.state(writer)
    columns = plugins.entropy_models.load(settings.entropy)()
    encode_rows(replace(base, layout=told), "1/", writer, positions, columns)
    writer.cut()
    for number, group in enumerate(groups, 2):
        encode_rows(replace(found, layout=told).part(group.rows), f"{number}/", writer, positions, columns)
        writer.cut()
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


@dataclass
class _Tile:
    """Rows `start` up to `end` of the scene, and how many of the base."""

    start: int
    end: int
    base: int


@dataclass
class _Group:
    tile: int
    rows: NDArray[np.int64]
    swell: float


def _tiles(cells: NDArray[np.int64], base: NDArray[np.int64], rows: int) -> list[_Tile]:
    """Runs of nearly equal length along the Morton curve, and what of the base lies nearest to each on it."""
    n = len(cells)
    count = min(math.ceil(n / rows), MOST_TILES)
    if not count:
        return []
    bounds = np.arange(count + 1) * n // count
    first = morton.encode(cells[bounds[:-1]])
    of_base = np.maximum(np.searchsorted(first, morton.encode(base), side="right") - 1, 0)
    held = np.bincount(of_base, minlength=count)
    return [_Tile(int(a), int(b), int(c)) for a, b, c in zip(bounds, bounds[1:], held, strict=False)]


def _groups(found: Lattice, tiles: list[_Tile], layers: int) -> list[_Group]:
    """Groups of all tiles in the order of the file: what covers most for its size comes first."""
    covered = coverage(found)
    ranked: list[tuple[float, int, _Group]] = []
    for number, tile in enumerate(tiles):
        worth = math.inf
        parts, swell = significant_first(found.part(slice(tile.start, tile.end)), layers, SMALLEST_PREFIX)
        for part, g in zip(parts, swell, strict=True):
            if not len(part):
                continue
            group = _Group(number, tile.start + part, g)
            worth = min(worth, float(covered[group.rows].mean()))
            ranked.append((-worth, len(ranked), group))
    return [group for _, _, group in sorted(ranked, key=lambda each: each[:2])]


def decode(reader: ContainerReader, plugins: PluginManager) -> GaussianModel:
    """The model of the packets that are there: the base where no group is, then group by group. BitstreamError."""
    layout = parsed(reader, TiledLayout)
    _check(layout, reader)
    groups = layout.groups[: reader.packets - 1]
    begun = np.zeros(len(layout.base), dtype=bool)
    swell_of = np.zeros(len(layout.base), dtype=np.float32)
    for tile, _, swell in groups:
        begun[tile], swell_of[tile] = True, swell
    base = sum(layout.base)
    n = base + sum(rows for _, rows, _ in groups)
    there = layout.model_copy(update={"num_gaussians": n})
    reader.allow(there.decoded_bytes, f"a model of {n:,} Gaussians")
    columns = layout.base_columns + layout.rest_columns
    found = Lattice(there, np.empty((n, 3), dtype=np.int64), np.empty((n, columns), dtype=np.int32))
    end = 0
    for number, rows in enumerate([base, *(rows for _, rows, _ in groups)], 1):
        start, end = end, end + rows
        decode_rows(found.part(slice(start, end)), f"{number}/", reader, plugins)
    keep = np.concatenate([np.repeat(~begun, layout.base), np.ones(n - base, dtype=bool)])
    swell = np.concatenate([np.zeros(base, np.float32), *(np.full(rows, swell_of[tile]) for tile, rows, _ in groups)])
    shown = replace(found.part(keep), layout=layout.model_copy(update={"num_gaussians": int(keep.sum())}))
    return finite(reconstruct(shown, swell[keep, None]), reader)


def _check(layout: TiledLayout, reader: ContainerReader) -> None:
    """Raise BitstreamError unless cuts, tiles and groups make one scene."""
    tiles = len(layout.base)
    last = {tile: swell for tile, _, swell in layout.groups}
    fits = (
        len(reader.cuts) == 1 + len(layout.groups)
        and sum(rows for _, rows, _ in layout.groups) == layout.num_gaussians
        and sorted(last) == list(range(tiles))
        and not any(last.values())
        and layout.primitive is None
    )
    if not fits:
        raise BitstreamError(f"{reader.name}: cuts, tiles and their Gaussians do not fit together", section="header")
