"""Cameras for Gaussians that came without any, by named recipes; the name belongs beside every figure measured so.

`plausible` makes up views as somebody would photograph or visit the scene, at about the resolution that its Gaussians
were made for, and parts them into those to fit with and those held out. `orbit16` and `inside16` are in
`ring_cameras`. All are functions of the Gaussians alone.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatwizard_core.api import Camera, GaussianModel, RasterOptions, SceneError
from sw_gaussians.render_options import antialias_of, eps2d_of
from sw_gaussians.rows import select

if TYPE_CHECKING:
    from splatwizard_core.api import Rasterizer

Array = NDArray[np.float64]

PLAUSIBLE = "plausible"
FOV = math.radians(60)
"""Horizontal field of view."""
ASPECT = 3 / 4
WIDTHS = (480, 1600)
"""Narrowest and widest picture, pixels."""
ELEVATIONS = (math.radians(-15), math.radians(70))
"""Of cameras outside, about up."""
DISTANCES = (0.9, 1.5, 2.5)
"""Of cameras outside, in radii over the sine of half the field of view."""
NEAR = 0.005
"""Near plane, in radii."""
CELLS = 24
"""Cells along each axis of the grid in which cameras inside are looked for."""
FREE = 0.05
"""Optical density below which a cell is free."""
FEWEST_PLACES = 8
"""Places inside that are looked for, half of them for the views held out; more where there are more views."""
TRIED_PLACES = 2
"""Free cells that are looked at for each place inside."""
CLEARANCE = 0.05
"""Distance around a place inside within which hardly anything is seen, in radii."""
HEADINGS = 4
"""Directions of view from each place inside."""
ROOM_SHARE, OBJECT_SHARE = 0.75, 0.2
"""Share of the views that are inside, by kind."""
ROOM = 0.6
"""Share of the solid angle that is opaque around a place in a room."""
SURROUNDED = 3.0
"""How many times as large as those of the middle the Gaussians far out are, where photographs were taken between them.
Fox has 5.6, room 7.7; chair, lego and demo have less than 1."""
FEWEST_COMPARED = 32
"""Gaussians far out and in the middle; of fewer nothing is told."""
TRIES = 8
"""Candidates per view before the least implausible one is taken."""
MOST_JUDGED = 200_000
"""Gaussians, the largest and most opaque ones, that are drawn to judge a candidate."""
JUDGED_WIDTH = 160
FEW_VALUES, SAMPLE, AROUND = 4096, 1024, 64
"""Values that are sorted for a quantile, and how many of more tell where it is, some places around."""
FEWEST = 6
"""Plausible views below which the scene is taken to be as large as its dense half."""


@dataclass(frozen=True)
class MadeUpCameras:
    """Cameras of a recipe.

    kind        what the scene looks like: "object" or "room"
    fit         cameras to decide with
    held_out    others, to measure with
    """

    recipe: str
    kind: str
    fit: list[Camera]
    held_out: list[Camera]


@dataclass(frozen=True)
class Extent:
    """Place of the visible area of Gaussians: its weighted median, and the radii that hold 50, 80 and 95 %."""

    center: Array
    r50: float
    r80: float
    r95: float


@dataclass(frozen=True)
class _Judged:
    """Gaussians as candidates are judged by them.

    model       the weightiest ones
    points, middles, areas      [n,3], [n], [n]: places, middle scale, opacity times product of the two largest scales
    growth      how many times as large as those of the middle the Gaussians far out are
    beside      the same as points, middles and areas on a GPU; None: there is none
    """

    model: GaussianModel
    points: Array
    middles: Array
    areas: Array
    rasterizer: Rasterizer
    options: RasterOptions
    growth: float
    beside: tuple[Tensor, Tensor, Tensor] | None = None

    def opacity(self, camera: Camera) -> Array:
        """Accumulated opacity [H,W] of a view."""
        with torch.no_grad():
            camera = camera.to(self.model.device)
            drawn = self.rasterizer.render(self.model.gaussians(camera, self.rasterizer), camera, self.options)
        assert drawn.alpha is not None  # it was asked for
        found: Array = drawn.alpha[0].double().cpu().numpy()
        return found


def plausible_cameras(
    model: GaussianModel,
    rasterizer: Rasterizer,
    *,
    fit: int = 12,
    held_out: int = 6,
    widest: int = 640,
    up: tuple[float, float, float] = (0.0, -1.0, 0.0),
) -> MadeUpCameras:
    """Make up cameras that see the scene as its photographs may have.

    fit, held_out   how many; fewer where the scene has no more
    widest          width of the largest picture, pixels; at least 480
    up              world direction

    Pixels are as large as the median Gaussian in front of the camera. Raises SceneError for Gaussians that no view
    shows.
    """
    judged, extent = _judged(model, rasterizer)
    up_axis = np.asarray(up, np.float64) / max(float(np.linalg.norm(up)), 1e-12)
    found = _cameras(judged, extent, fit, held_out, widest, up_axis)
    if found is None:  # what lies far off is not what there is to see
        small = replace(extent, r80=extent.r50, r95=extent.r50)
        found = _cameras(judged, small, fit, held_out, widest, up_axis, takes_any=True)
    if found is None:
        raise SceneError("no view that was made up shows any of its Gaussians: give cameras in a file")
    return found


def extent_of(points: Array, areas: Array, sizes: Array) -> Extent:
    """Return centre and radii of Gaussians.

    points  [n,3] finite
    areas   [n] weights
    sizes   [n] largest standard deviations: a scene is at least three of them wide
    """
    center = np.array([weighted_quantiles(points[:, axis], areas, (0.5,))[0] for axis in range(3)])
    radii = np.linalg.norm(points - center, axis=1)
    floor = 3 * float(weighted_quantiles(sizes, areas, (0.5,))[0])
    r50, r80, r95 = np.maximum(weighted_quantiles(radii, areas, (0.5, 0.8, 0.95)), max(floor, 1e-12))
    return Extent(center, float(r50), float(r80), float(r95))


def weighted_quantiles(values: Array, weights: Array, shares: tuple[float, ...]) -> Array:
    """Return the smallest values [len(shares)] below or at which so much of the weight lies."""
    total = float(weights.sum())
    return np.array([_weighted_quantile(values, weights, share * total) for share in shares])


def _weighted_quantile(values: Array, weights: Array, wanted: float) -> float:
    """The smallest value below or at which `wanted` of the weight lies.

    Where there are many, a sample tells between which two it is: a tenth of the time of sorting all.
    """
    while len(values) > FEW_VALUES:
        some = slice(None, None, len(values) // SAMPLE)
        order = np.argsort(values[some], kind="stable")
        sample, total = values[some][order], np.cumsum(weights[some][order])
        place = int(np.searchsorted(total, wanted / max(float(weights.sum()), 1e-300) * total[-1]))
        low, high = sample[max(place - AROUND, 0)], sample[min(place + AROUND, len(sample) - 1)]
        below, here = float(weights[values < low].sum()), (values >= low) & (values <= high)
        if here.all() or not below < wanted <= below + float(weights[here].sum()):
            break
        values, weights, wanted = values[here], weights[here], wanted - below
    order = np.argsort(values, kind="stable")
    place = int(np.searchsorted(np.cumsum(weights[order]), wanted))
    return float(values[order][min(place, len(values) - 1)])


def extent_on_gpu(points: Tensor, areas: Tensor, sizes: Tensor) -> Extent:
    """As `extent_of`, of tensors where they are."""
    center = torch.cat([quantiles_on_gpu(axis, areas, (0.5,)) for axis in points.unbind(1)])
    radii = (points - center).square().sum(dim=1).sqrt()
    floor = 3 * quantiles_on_gpu(sizes, areas, (0.5,))
    r50, r80, r95 = quantiles_on_gpu(radii, areas, (0.5, 0.8, 0.95)).maximum(floor.clamp_min(1e-12)).tolist()
    return Extent(center.cpu().numpy(), r50, r80, r95)


def quantiles_on_gpu(values: Tensor, weights: Tensor, shares: tuple[float, ...]) -> Tensor:
    """As `weighted_quantiles`, of tensors [n] where they are. Sums are of integers: those of floats vary from run to
    run."""
    order = values.argsort(stable=True)
    total = (weights[order] * (2.0**52 / weights.sum())).long().cumsum(dim=0)
    wanted = torch.tensor(shares, dtype=torch.float64, device=values.device) * total[-1]
    found: Tensor = values[order[torch.searchsorted(total, wanted.ceil().long()).clamp_max(len(values) - 1)]]
    return found


def _judged(model: GaussianModel, rasterizer: Rasterizer) -> tuple[_Judged, Extent]:
    with torch.no_grad():
        scales = model.scales.double().sort(dim=1, descending=True).values
        opacities = model.opacities.double()
        points = model.means.double()
        areas = opacities * scales[:, 0] * scales[:, 1]
        sound = points.isfinite().all(dim=1) & areas.isfinite() & (areas > 0)
        rows = sound.nonzero().squeeze(1)
        if not len(rows):
            raise SceneError("no Gaussian is opaque and finite, so there is nothing to look at")
        sizes, on_gpu = scales[rows, 0], model.device.type != "cpu"
        measured = points[rows], areas[rows], sizes
        extent = extent_on_gpu(*measured) if on_gpu else extent_of(*(each.numpy() for each in measured))
        growth = _growth(points[rows], scales[rows, 1], extent)
        if len(rows) > MOST_JUDGED:
            rows = rows[(-areas[rows]).argsort(stable=True)[:MOST_JUDGED]].sort().values
        options = RasterOptions(alpha=True, antialias=antialias_of(model), eps2d=eps2d_of(model))
        kept = points[rows], scales[rows, 1], areas[rows]
        arrays = (each.cpu().numpy() for each in kept)
        return _Judged(select(model, rows), *arrays, rasterizer, options, growth, kept if on_gpu else None), extent


def _growth(points: Tensor, middles: Tensor, extent: Extent) -> float:
    """Median size of the Gaussians beyond 80 % of the visible area by that of those within half of it.

    Gaussians shrink to about a pixel: from outside of an object all are as near, from within a room those far out are
    farther than those around the camera.
    """
    radii = (points - torch.from_numpy(extent.center).to(points)).norm(dim=1)
    far, near = middles[(radii > extent.r80) & (radii <= extent.r95)], middles[radii <= extent.r50]
    if min(len(far), len(near)) < FEWEST_COMPARED:
        return 1.0
    return float(far.median() / near.median())


def _cameras(
    judged: _Judged, extent: Extent, fit: int, held_out: int, widest: int, up: Array, *, takes_any: bool = False
) -> MadeUpCameras | None:
    """None where too few views are plausible, and with `takes_any` where none shows anything."""
    count = max(FEWEST_PLACES, 2 * math.ceil(ROOM_SHARE * fit / HEADINGS))
    places, maps = _spread_out(_open_places(judged, extent, extent.r95, count), extent, count)
    near = [_closed(seen) for place, seen in zip(places, maps, strict=True)
            if np.linalg.norm(place - extent.center) <= extent.r50]  # fmt: skip
    kind = "object"
    if judged.growth > SURROUNDED:
        kind = "room"
        places, maps = _spread_out(_open_places(judged, extent, extent.r50, count), extent, count)
    elif _is_room(near):
        middle = _open_places(judged, extent, extent.r50, count)
        closed = [_closed(seen) for _, seen in middle]
        if _is_room(closed):  # not just one nook of an object, as below the seat of a chair
            kind = "room"
            # Free cells also lie beyond its walls.
            walled = [each for each, share in zip(middle, closed, strict=True) if share >= 0.9 * max(closed)]
            places, maps = _spread_out(walled, extent, count)
    inside_share = (ROOM_SHARE if kind == "room" else OBJECT_SHARE) if len(places) > 1 else 0.0
    headings = [_headings(*each, up) for each in maps]
    parts, plausible = [], 0
    for parity, count in enumerate((fit, held_out)):
        within = _inside(places[parity::2], headings[parity::2])
        inside, sound = _chosen(judged, extent, round(inside_share * count), widest, up, within)
        outside, more = _chosen(judged, extent, count - len(inside), widest, up, _outside(extent, up, parity))
        parts.append(inside + outside)
        plausible += sound + more
    if (plausible < min(FEWEST, fit + held_out) and not takes_any) or not all(parts):
        return None
    return MadeUpCameras(PLAUSIBLE, kind, *parts)


def _chosen(
    judged: _Judged, extent: Extent, wanted: int, widest: int, up: Array, candidates: Iterator[tuple[Array, Array]]
) -> tuple[list[Camera], int]:
    """The first plausible views of (eye, target), filled up with the least implausible ones; how many are plausible."""
    good: list[Camera] = []
    others: list[tuple[float, int, Camera]] = []
    for tried, (eye, target) in enumerate(candidates):
        if len(good) == wanted or tried == TRIES * wanted:
            break
        camera = _camera(judged, eye, target, up, extent, widest)
        small = camera.resized(JUDGED_WIDTH, round(JUDGED_WIDTH * ASPECT))
        opacity = judged.opacity(small)
        blocked = judged.opacity(replace(small, far=0.02 * extent.r80)).mean() if extent.r80 > 0 else 0.0
        seen = opacity > 1 / 255
        if not seen.any():
            continue
        solid = float(opacity[seen].mean())
        if blocked < 0.1 and solid >= 0.3 and seen.mean() >= 0.05:
            good.append(camera)
        else:
            others.append((-solid * float(seen.mean()) * (1 - float(blocked)), tried, camera))
    more = [camera for *_, camera in sorted(others, key=lambda each: each[:2])[: wanted - len(good)]]
    return good + more, len(good)


def _camera(judged: _Judged, eye: Array, target: Array, up: Array, extent: Extent, widest: int) -> Camera:
    """A camera whose pixels are as large as the median Gaussian that it sees."""
    given = [torch.from_numpy(np.ascontiguousarray(each)).float() for each in (eye, target, _upright(eye, target, up))]
    width, height = _size(WIDTHS[0])
    camera = Camera.look_at(*given, width=width, height=height, fov_x=FOV, near=NEAR * extent.r80)
    size = _median_size(judged, camera) if judged.beside is None else _median_size_on_gpu(*judged.beside, camera)
    if size is None:
        return camera
    focal = 1 / max(size, 1e-12)
    low, high = WIDTHS[0], max(WIDTHS[0], min(widest, WIDTHS[1]))
    return camera.resized(*_size(min(max(2 * focal * math.tan(FOV / 2), low), high)))


def _median_size(judged: _Judged, camera: Camera) -> float | None:
    """Middle scale over depth of the median of what a camera has before it; None: there is nothing."""
    local = judged.points @ camera.R.double().numpy().T + camera.tau.double().numpy()
    x, y, z = np.abs(local[:, 0]), np.abs(local[:, 1]), local[:, 2]
    tx, ty = camera.tan_half_fov
    inside = (z > camera.near) & (x < tx * z) & (y < ty * z)
    if not inside.any():
        return None
    return float(weighted_quantiles(judged.middles[inside] / z[inside], judged.areas[inside], (0.5,))[0])


def _median_size_on_gpu(points: Tensor, middles: Tensor, areas: Tensor, camera: Camera) -> float | None:
    local = points @ camera.R.double().to(points.device).T + camera.tau.double().to(points.device)
    x, y, z = local.unbind(1)
    tx, ty = camera.tan_half_fov
    inside = (z > camera.near) & (x.abs() < tx * z) & (y.abs() < ty * z)
    if not bool(inside.any()):
        return None
    return float(quantiles_on_gpu(middles[inside] / z[inside], areas[inside], (0.5,)))


def _size(width: float) -> tuple[int, int]:
    """Width and height, multiples of 16 and 12."""
    units = max(1, round(width / 16))
    return 16 * units, 12 * units


def _upright(eye: Array, target: Array, up: Array) -> Array:
    """Up, or another axis where the camera looks along it."""
    forward = (target - eye) / max(float(np.linalg.norm(target - eye)), 1e-12)
    if abs(float(forward @ up)) < 0.98:
        return up
    other: Array = np.eye(3)[int(np.abs(up).argmin())]
    return other


def level_axes(up: Array) -> tuple[Array, Array]:
    """Two directions that complete `up` to an orthonormal basis."""
    first = next(axis for axis in np.eye(3)[[2, 0, 1]] if np.linalg.norm(np.cross(axis, up)) > 1e-6)
    first = first - (first @ up) * up
    first /= np.linalg.norm(first)
    return first, np.cross(up, first)


def _outside(extent: Extent, up: Array, parity: int) -> Iterator[tuple[Array, Array]]:
    """(eye, target) outside, without end: every other member of one sequence that fills the sphere evenly."""
    f, s = level_axes(up)
    low, high = (math.sin(each) for each in ELEVATIONS)
    number = parity
    while True:
        u, v, a, b, c = ((0.5 + number * step) % 1 for step in _EVEN)
        sine, azimuth = low + (high - low) * u, 2 * math.pi * v
        across = math.sqrt(max(0.0, 1 - sine * sine))
        direction = across * (math.cos(azimuth) * f + math.sin(azimuth) * s) + sine * up
        distance = DISTANCES[number // 2 % len(DISTANCES)] * extent.r80 / math.sin(FOV / 2)
        target = extent.center + 0.2 * extent.r50 * (2 * np.array([a, b, c]) - 1)
        yield target + distance * direction, target
        number += 2


def _powers_of_root(dimensions: int) -> tuple[float, ...]:
    """Steps of the additive sequence that fills a cube of so many dimensions evenly: powers of 1/g, g^(d+1) = g + 1."""
    g = 2.0
    for _ in range(60):
        g = (1 + g) ** (1 / (dimensions + 1))
    return tuple(g ** -(k + 1) for k in range(dimensions))


_EVEN = _powers_of_root(5)


def _inside(places: list[Array], headings: list[list[Array]]) -> Iterator[tuple[Array, Array]]:
    for turn in range(HEADINGS):
        for place, directions in zip(places, headings, strict=True):
            if turn < len(directions):
                yield place, place + directions[turn]


def _is_room(closed: list[float]) -> bool:
    """Whether around most of some places nearly all directions are opaque."""
    return bool(closed) and float(np.median(closed)) > ROOM


def _open_places(judged: _Judged, extent: Extent, radius: float, count: int) -> list[tuple[Array, tuple[Array, Array]]]:
    """Places within a radius about the middle where nothing is near, with their cube maps; of some twice as many."""
    places = _free_places(judged, extent, radius, TRIED_PLACES * count)
    return [(place, _cube_map(judged, place, extent)) for place in places
            if _cube_map(judged, place, extent, far=CLEARANCE * extent.r80, size=16)[0].mean() <= 0.1]  # fmt: skip


def _spread_out(
    found: list[tuple[Array, tuple[Array, Array]]], extent: Extent, count: int
) -> tuple[list[Array], list[tuple[Array, Array]]]:
    """Up to `count` of these places, far from each other, and their cube maps."""
    order = _spread(np.array([place for place, _ in found]).reshape(-1, 3), extent.center)[:count]
    return [found[i][0] for i in order], [found[i][1] for i in order]


def _free_places(judged: _Judged, extent: Extent, radius: float, count: int) -> Array:
    """Centres [n,3] of free cells, at most `count`, evenly taken from those within a radius about the middle."""
    edge = 2 * extent.r95 / CELLS
    corner = extent.center - extent.r95
    cells = np.floor((judged.points - corner) / edge)
    within = ((cells >= 0) & (cells < CELLS)).all(1)
    index = np.ravel_multi_index(tuple(cells[within].astype(np.int64).T), (CELLS,) * 3)
    density = np.bincount(index, 2 * math.pi * judged.areas[within], CELLS**3) / edge**2
    all_cells = np.stack(np.unravel_index(np.arange(CELLS**3), (CELLS,) * 3), axis=1)
    centers = corner + (all_cells + 0.5) * edge
    away = np.linalg.norm(centers - extent.center, axis=1)
    free = centers[(density < FREE) & (away <= radius)]
    chosen: Array = free[_even(len(free), min(count, len(free)))]
    return chosen


def _even(count: int, some: int) -> NDArray[np.int64]:
    """So many of 0 .. count - 1, evenly spread."""
    return ((np.arange(some) + 0.5) * count / max(some, 1)).astype(np.int64)


def _spread(points: Array, center: Array) -> list[int]:
    """Order of points [n,3]: the nearest to the centre, then each time the farthest from those before."""
    if not len(points):
        return []
    order = [int(np.linalg.norm(points - center, axis=1).argmin())]
    nearest = np.linalg.norm(points - points[order[0]], axis=1)
    while len(order) < len(points):
        nearest[order[-1]] = -1.0
        order.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, np.linalg.norm(points - points[order[-1]], axis=1))
    return order


_FACES = (
    ((0, 0, 1), (0, -1, 0)), ((1, 0, 0), (0, -1, 0)), ((0, 0, -1), (0, -1, 0)),
    ((-1, 0, 0), (0, -1, 0)), ((0, 1, 0), (0, 0, 1)), ((0, -1, 0), (0, 0, 1)),
)  # fmt: skip
"""Forward and up of the faces of a cube."""


def _cube_map(
    judged: _Judged, place: Array, extent: Extent, *, far: float = 1e10, size: int = 32
) -> tuple[Array, Array]:
    """Opacity [6*size^2] seen from a place in all directions, and these [6*size^2,3].

    far     what lies behind is not drawn, world units
    """
    opacities, directions = [], []
    eye = torch.from_numpy(place).float()
    step = (np.arange(size) + 0.5) / size * 2 - 1
    x, y = np.meshgrid(step, step)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    for forward, above in _FACES:
        f, u = (torch.tensor(each, dtype=torch.float32) for each in (forward, above))
        camera = Camera.look_at(
            torch.zeros(3), f, u, width=size, height=size, fov_x=math.pi / 2, near=NEAR * extent.r80
        )
        opacities.append(judged.opacity(replace(camera, tau=-camera.R @ eye, far=far)).ravel())
        directions.append(rays @ camera.R.double().numpy())
    return np.concatenate(opacities), np.concatenate(directions)


def _closed(seen: tuple[Array, Array]) -> float:
    """Share of the directions of a cube map that are opaque."""
    return float((seen[0] > 0.9).mean())


def _headings(opacity: Array, directions: Array, up: Array) -> list[Array]:
    """Up to `HEADINGS` directions, at most 50 degrees off the horizon, towards which most is seen, 60 degrees apart."""
    level = np.abs(directions @ up) < math.sin(math.radians(50))
    candidates = directions[level][::13]
    cover = np.stack([opacity[directions @ each > math.cos(FOV / 2)].mean() for each in candidates])
    found: list[Array] = []
    while len(found) < HEADINGS and (cover > 0).any():
        best = int(cover.argmax())
        found.append(candidates[best])
        cover = np.where(candidates @ candidates[best] > 0.5, -1.0, cover)
    return found
