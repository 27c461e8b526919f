"""A scene too large for memory: its higher spherical harmonics, most of it, lie in a file.

What is left, 56 bytes of a Gaussian, is a model of SH degree 0 in Morton order, and is drawn, ranked and cut like any
other. It is parted into tiles, runs of that order; a tile is whole in memory while something is done with it.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from sw_gaussians.morton import interleave, morton_order
from sw_gaussians.surfels import refuse_surfels
from sw_reference.spherical_harmonics import sh_colors
from torch import Tensor

from splatwizard_core.api import SH, Camera, GaussianInputs, GaussianModel, SceneError
from sw_compress.ply_blocks import PlyBlocks
from sw_compress.rows import like, select
from sw_compress.shelf import Place, Shelf
from sw_compress.source import FAINTEST

if TYPE_CHECKING:
    from splatwizard_core.api import Rasterizer

TILE = 1 << 20
"""Gaussians of a tile."""
MOST_TILES = 64
"""As many packets as a file can have; a larger scene has larger tiles."""
ROWS_AT_ONCE = 1 << 16
"""Rows whose colours, or places along a curve, are found together."""
BITS = 20
"""Of a coordinate along a curve."""


class Curve:
    """A Morton curve through points, in parts.

    points  [N,3] along it
    starts  first row of each part
    """

    def __init__(self, points: Tensor, starts: Sequence[int]) -> None:
        self._low = points.amin(0).double()
        self._step = (2**BITS - 1) / (points.amax(0).double() - self._low).clamp_min(1e-30)
        self._starts = self._codes(points[list(starts)]).sort().values

    def parts(self, points: Tensor) -> Tensor:
        """The part [M] that each of some points [M,3] lies in."""
        codes = torch.cat([self._codes(part) for part in points.split(ROWS_AT_ONCE)])
        return (torch.searchsorted(self._starts, codes, right=True) - 1).clamp_min(0)

    def _codes(self, points: Tensor) -> Tensor:
        cells = ((points.double() - self._low) * self._step).long().clamp(0, 2**BITS - 1)
        found: Tensor = interleave(cells)
        return found


@dataclass
class LargeScene:
    """Gaussians in tiles.

    light   all of them [N], SH degree 0 alone
    degree  of what lies in the file
    limits  first row of each tile, then N
    """

    light: GaussianModel
    degree: int
    limits: list[int]
    shelf: Shelf
    _rest: list[list[Place]]
    _goes_to: list[Tensor | None]

    @property
    def num_rows(self) -> int:
        return self.light.num_rows

    @property
    def active_sh_degree(self) -> int:
        return self.degree

    @property
    def device(self) -> torch.device:
        return self.light.device

    @property
    def tiles(self) -> range:
        """Numbers of the tiles."""
        return range(len(self.limits) - 1)

    def rows(self, tile: int) -> slice:
        """Rows of a tile."""
        return slice(self.limits[tile], self.limits[tile + 1])

    def rest(self, tile: int) -> Tensor:
        """Higher SH coefficients [n,K-1,3] of a tile."""
        count, width = self.limits[tile + 1] - self.limits[tile], (self.degree + 1) ** 2 - 1
        if not width:
            return self.light.means.new_zeros(count, 0, 3)
        found, goes_to = torch.empty(count, width, 3), self._goes_to[tile]
        at = 0
        for place in self._rest[tile]:
            part = self.shelf.get(place)
            here = slice(at, at + len(part))
            found[here if goes_to is None else goes_to[here].long()] = part
            at += len(part)
        return found.to(self.device)

    def tile(self, tile: int, rows: Tensor | None = None) -> GaussianModel:
        """The Gaussians of a tile, or some of its rows."""
        rest, part = self.rest(tile), self.rows(tile)
        some = torch.arange(part.start, part.stop, device=self.device) if rows is None else part.start + rows
        raw = {name: getattr(self.light, name).detach()[some] for name in self.light.RAW}
        raw["sh_rest"] = rest if rows is None else rest[rows]
        return like(self.light, GaussianModel(**raw))

    def part(self, rows: Tensor) -> GaussianModel:
        """The Gaussians of an index [M], ascending."""
        found = []
        for tile in self.tiles:
            part = self.rows(tile)
            some = rows[(rows >= part.start) & (rows < part.stop)] - part.start
            if len(some):
                found.append(self.tile(tile, some))
        return joined(found, self.light)

    @torch.no_grad()
    def gaussians(self, camera: Camera, rasterizer: Rasterizer) -> GaussianInputs:
        """All Gaussians in their colours as the camera sees them."""
        light = self.light
        colors = self.colors(camera, None)[0]
        return GaussianInputs(light.means, light.opacities, light.scales, light.quats, colors=colors)

    @torch.no_grad()
    def colors(
        self, camera: Camera, seen: Tensor | None, *others: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
    ) -> list[Tensor]:
        """Colours [N,3] as the camera sees them.

        seen    whether each Gaussian [N] needs one; None: all do
        others  give other coefficients, dc [n,1,3] and the rest, of some rows [n] and their rest: more colours for each
        """
        light = self.light
        found = [torch.zeros_like(light.means) for _ in range(1 + len(others))]
        center = camera.center.to(light.means)
        for tile in self.tiles:
            part, rest = self.rows(tile), self.rest(tile)
            rows = torch.arange(part.start, part.stop, device=self.device)
            if seen is not None:
                mine = seen[part]
                rows, rest = rows[mine], rest[mine]
            if not len(rows):
                continue
            for some, higher in zip(rows.split(ROWS_AT_ONCE), rest.split(ROWS_AT_ONCE), strict=True):
                known = [(light.sh_dc[some], higher), *(other(some, higher) for other in others)]
                for colors, (dc, each) in zip(found, known, strict=True):
                    sh = SH(dc=dc, rest=each if self.degree else None, active_degree=self.degree)
                    colors[some] = sh_colors(sh, center, light.means[some])
        return found

    @classmethod
    def of_tiles(cls, tiles: Iterable[GaussianModel], shelf: Shelf) -> LargeScene:
        """A scene of what is known tile by tile."""
        lights, places, limits = [], [], [0]
        degree = 0
        for tile in tiles:
            degree = tile.active_sh_degree
            lights.append(_light(tile))
            places.append([shelf.put(tile.sh_rest)])
            limits.append(limits[-1] + tile.num_rows)
        return cls(joined(lights, lights[0]), degree, limits, shelf, places, [None] * len(places))


def read_scene(blocks: PlyBlocks, shelf: Shelf, device: torch.device, name: str) -> tuple[LargeScene, int]:
    """Read a scene, without what can never be drawn; and how many Gaussians mean something.

    blocks      rows of a file, which are read twice
    name        for messages

    Raises SceneError where nothing can be seen, UserInputError for surfels.
    """
    read = count = degree = 0
    raw: dict[str, Tensor] = {}  # of all rows at once: many small tensors would leave holes in memory
    for block in blocks:
        refuse_surfels(block, f"{name}: `sw compress`")
        read, degree = read + block.num_rows, block.active_sh_degree
        told = _light(_drawn(block))
        if not raw:
            raw = {
                each: getattr(told, each).new_empty(blocks.count, *getattr(told, each).shape[1:]) for each in told.RAW
            }
        for each, values in raw.items():
            values[count : count + told.num_rows] = getattr(told, each)
        count += told.num_rows
    if not count:
        raise SceneError(f"{name}: holds no Gaussian that could be seen")
    light = like(told, GaussianModel(**{each: values[:count] for each, values in raw.items()}))
    del raw
    order = morton_order(light.means.detach())
    light = select(light, order)
    size = max(TILE, -(-count // MOST_TILES))
    limits = [*range(0, count, size), count]
    tile_of = torch.empty(count, dtype=torch.uint8)
    tile_of[order] = (torch.arange(count) // size).to(torch.uint8)
    # A tile's rows come in the order of the file.
    goes_to = [torch.argsort(order[start:end]).int() for start, end in itertools.pairwise(limits)]
    del order
    rest: list[list[Place]] = [[] for _ in goes_to]
    if degree:
        at = 0
        for block in blocks:
            part = _drawn(block).sh_rest.detach()
            of = tile_of[at : at + len(part)]
            at += len(part)
            for tile in of.unique().tolist():
                rest[tile].append(shelf.put(part[of == tile]))
    return LargeScene(light.to(device), degree, limits, shelf, rest, list(goes_to)), read


def joined(parts: Sequence[GaussianModel], told: GaussianModel) -> GaussianModel:
    """One model of several, which are emptied on the way: of none two whole copies are in memory.

    told    has what the file told
    """
    raw = {}
    for name in told.RAW:
        raw[name] = torch.cat([getattr(each, name).detach() for each in parts])
        for each in parts:
            if each is not told:
                setattr(each, name, torch.nn.Parameter(raw[name][:0], requires_grad=False))
    return like(told, GaussianModel(**raw))


def _drawn(model: GaussianModel) -> GaussianModel:
    drawn = model.opacities >= FAINTEST
    return model.eval().requires_grad_(False) if bool(drawn.all()) else select(model, drawn)


def _light(model: GaussianModel) -> GaussianModel:
    """The same without higher SH coefficients."""
    raw = {name: getattr(model, name).detach() for name in model.RAW}
    raw["sh_rest"] = raw["sh_rest"].new_zeros(model.num_rows, 0, 3)
    return like(model, GaussianModel(**raw))
