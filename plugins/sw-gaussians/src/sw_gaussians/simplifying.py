"""Fewer Gaussians for the same scene: the cheapest pairs of neighbours merge, wave after wave.

In each wave every Gaussian points at its cheapest neighbour along a space-filling curve; pairs that point at each other
merge, the cheapest first. Prices are those of `merge_costs`, and are found anew for each wave.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from splatwizard_core.api import GaussianModel
from sw_gaussians import face
from sw_gaussians.heap import trim
from sw_gaussians.made_up_cameras import extent_of
from sw_gaussians.merge_costs import Columns, closeness, columns_of, prices
from sw_gaussians.merging import Splats, logits_of, merge_groups, model_of, splats_of
from sw_gaussians.morton import interleave
from sw_gaussians.native import GAUSSIANS

WINDOW = 8
"""Neighbours along the curve, before and behind, that a Gaussian may merge with in a wave."""
NEAR = 4.0
"""Squared Mahalanobis distance, by both covariances, within which neighbours merge while there are enough of them."""
TAKEN = 0.6
"""Share of a wave's pairs that merge, the cheapest: those left see new partners in the next."""
ENOUGH = 0.1
"""A wave that merges a smaller share of all Gaussians than this is followed by one that looks further."""
COLUMNS = 15
"""Of the table that prices look at."""
CELLS = 20
"""Bits of a coordinate along the curve."""
PAIRS_AT_ONCE = {"cpu": 1 << 14, "cuda": 1 << 17}
"""Pairs that merge together: in float64 each takes some kB on the way, which stay in the cache of a core."""
ROWS_AT_ONCE = {"cpu": 1 << 14, "cuda": 1 << 21}
"""Pairs whose prices are found together: intermediate columns stay in the cache of a core."""
MEASURED = {"cpu": 1 << 17, "cuda": 1 << 15}
"""Gaussians by which the size of a scene is told: they are sorted on the CPU."""


@torch.no_grad()
def merged_to(
    model: GaussianModel, count: int, *, significance: Tensor | None = None, widen: bool = False
) -> GaussianModel:
    """Return the scene with at most `count` Gaussians, each wave merging pairs of neighbours.

    significance    [N] >= 0: what a squared error of colour of each costs in pictures; a price is multiplied by that of
                    its pair over the median. None: all alike
    widen           as of `merge_groups`

    The result is a new model without the SH bands that were not active; one that is small enough already is copied.
    Raises ShapeError for surfels.
    """
    rows = torch.arange(model.num_rows, device=model.device)
    pool = _reduced(model, rows, count, significance, None, widen)
    return model_of(pool.splats, pool.order, model)


@torch.no_grad()
def merged_by(
    model: GaussianModel, rows: Tensor, count: int, significance: Tensor, *, summed: Tensor | None = None,
    widen: bool = False, faintest: float = -math.inf,
) -> tuple[GaussianModel, Tensor]:  # fmt: skip
    """As `merged_to` of some rows [M], with what each Gaussian of the result stands for: sums.

    significance    [M] of these rows
    summed          [M] what is summed; None: the significance
    faintest        logit of the opacity below which a Gaussian is left out in the end
    """
    pool = _reduced(model, rows, count, significance, summed, widen)
    left = pool.order[logits_of(pool.splats.opacities[pool.order]) >= faintest]
    if pool.summed is not None:
        return model_of(pool.splats, left, model), pool.summed[left]
    assert pool.weights is not None  # they were given
    found = pool.weights[left].to(significance) * significance.median().clamp_min(1e-30)
    return model_of(pool.splats, left, model), found


def _reduced(
    model: GaussianModel, rows: Tensor, count: int, significance: Tensor | None, summed: Tensor | None, widen: bool
) -> _Pool:
    """Merge some rows of a model until at most so many are left; weights are in medians."""
    curve = _curve(model.means.detach().index_select(0, rows), 0)
    weights = None
    if significance is not None:
        weights = (significance / significance.median().clamp_min(1e-30)).to(model.means)[curve]
    pool = _Pool.of(splats_of(model, rows[curve]), weights, None if summed is None else summed[curve])
    near, wave = NEAR, 0
    while (n := len(pool.order)) > max(count, 1):
        if pool.table.device.type == "cpu":
            trim()
        pool.follow_curve(wave)
        pairs = _wave(pool, near, wave)
        pairs = pairs[: min(n - count, math.ceil(TAKEN * len(pairs)))]
        if len(pairs) < min(ENOUGH * n, n - count):
            near *= 4
        pool.merge(pairs, widen)
        wave += 1
        del pairs
    trim()
    return pool


@dataclass
class _Pool:
    """Gaussians that merge in place: neighbours in space stay neighbours in memory.

    splats, weights, summed     [N] of all rows; what was merged stands in the first row of its pair
    table               [N,15] what prices look at but SH: place 3, covariance 6, volume, mass, opacity, colour 3
    order               [n] rows that are left
    unit, center        size and middle of the scene, world units
    """

    splats: Splats
    weights: Tensor | None
    summed: Tensor | None
    table: Tensor
    order: Tensor
    unit: float
    center: Tensor

    @classmethod
    def of(cls, splats: Splats, weights: Tensor | None, summed: Tensor | None = None) -> _Pool:
        """These Gaussians, best along a curve; they are overwritten."""
        unit, center = _unit(splats), splats.means.mean(dim=0)
        parts = (Splats(*each) for each in zip(*map(_blocks, splats), strict=True))
        table, end = splats.means.new_empty(len(splats.means), COLUMNS), 0
        for part in parts:
            start, end = end, end + len(part.means)
            table[start:end] = _table(part, unit, center)
        return cls(splats, weights, summed, table, torch.arange(len(table), device=table.device), unit, center)

    @property
    def is_native(self) -> bool:
        """Whether the compiled kernels take these Gaussians: float32 on the CPU."""
        return self.table.device.type == "cpu" and self.table.dtype == torch.float32 and GAUSSIANS.try_load()

    def follow_curve(self, wave: int) -> None:
        """Bring what is left into the order of a wave's curve."""
        self.order = self.order[_curve(self.splats.means[self.order], wave)]

    def columns(self, rows: Tensor) -> Columns:
        """The columns that prices look at, of some rows."""
        found = self.table[rows].T.contiguous()
        return Columns(found[:3], found[3:9], found[9], found[10], found[11], found[12:15],
                       self.splats.sh[rows, 1:].flatten(1).T.contiguous())  # fmt: skip

    def merge(self, pairs: Tensor, widen: bool) -> None:
        """One Gaussian in place of each pair of rows [P,2]."""
        (_native_merge if self.is_native else _merge)(self, pairs, widen)
        for each in (self.weights, self.summed):
            if each is not None:
                each[pairs[:, 0]] = each[pairs].sum(dim=1)
        gone = torch.zeros(len(self.table), dtype=torch.bool, device=pairs.device)
        gone[pairs[:, 1]] = True
        self.order = self.order[~gone[self.order]]


def _blocks(values: Tensor) -> tuple[Tensor, ...]:
    """Rows in blocks whose intermediate columns stay in the cache of a core."""
    return values.split(_at_once(ROWS_AT_ONCE, values))


def _at_once(rows: dict[str, int], values: Tensor) -> int:
    """Return the number that is worked on together where these values are."""
    return rows["cpu" if values.device.type == "cpu" else "cuda"]


def _table(splats: Splats, unit: float, center: Tensor) -> Tensor:
    """Columns [N,15] of Gaussians, without their SH."""
    found = columns_of(splats._replace(sh=splats.sh[:, :1]), unit, center)
    single = (found.volumes[None], found.masses[None], found.opacities[None])
    return torch.cat([found.places, found.six, *single, found.colors]).T


def level_counts(count: int, levels: int | None = None, *, smallest: int = 20_000) -> list[int]:
    """Return how many Gaussians each level has, each half of the one before, the scene itself first.

    levels  how many; None: down to a 64th of the scene, or to `smallest` if that is more
    """
    counts = [count]
    end = max(count / 64, smallest)
    while len(counts) < levels if levels is not None else counts[-1] / 2 >= end:
        if (half := math.ceil(counts[-1] / 2)) == counts[-1]:
            break
        counts.append(half)
    return counts


def levels_of(model: GaussianModel, levels: int | None = None) -> Iterator[GaussianModel]:
    """The scene itself, then ever coarser ones, each merged from the one before; see `level_counts`."""
    yield model
    for count in level_counts(model.num_rows, levels)[1:]:
        model = merged_to(model, count, widen=True)
        yield model


def _unit(splats: Splats) -> float:
    """Size of the scene: the radius that holds half of what is visible, by Gaussians from everywhere in it."""
    some = slice(None, None, max(len(splats.means) // _at_once(MEASURED, splats.means), 1))
    sizes = splats.scales[some].double().sort(dim=1, descending=True).values
    areas = splats.opacities[some].double() * sizes[:, 0] * sizes[:, 1]
    points, weights, widths = (values.cpu().numpy() for values in (splats.means[some].double(), areas, sizes[:, 0]))
    return extent_of(points, weights, widths).r50


def _curve(points: Tensor, wave: int) -> Tensor:
    """Rows along a Morton curve whose cells are shifted in every wave: no border between two stays one."""
    low = points.amin(dim=0).double()
    side = (points.amax(dim=0).double() - low).max().clamp_min(1e-30)
    shift = torch.tensor([(wave * step) % 1 for step in (0.618034, 0.754878, 0.569840)], device=points.device)
    step = (2**CELLS - 1) / 2
    codes = [interleave(((part.double() - low) * (step / side) + step * shift).long()) for part in _blocks(points)]
    return torch.argsort(torch.cat(codes), stable=True)


def _wave(pool: _Pool, near: float, wave: int) -> Tensor:
    """Pairs [P,2] of rows that are each other's cheapest neighbours along the curve, the cheapest first."""
    best, partner = (_native_partners if pool.is_native else _partners)(pool, near, wave)
    places = torch.arange(len(best), device=best.device)
    first = places[(partner > places) & (partner[partner] == places)]
    first = first[torch.argsort(best[first], stable=True)]
    return pool.order[torch.stack([first, partner[first]], dim=1)]


def _merge(pool: _Pool, pairs: Tensor, widen: bool) -> None:
    """Merge each pair of rows [P,2] into its first row."""
    for part in pairs.split(_at_once(PAIRS_AT_ONCE, pairs)):
        new = merge_groups(pool.splats.rows(part), widen=widen).to(pool.table.dtype)
        for all_of, values in zip(pool.splats, new, strict=True):
            all_of[part[:, 0]] = values
        pool.table[part[:, 0]] = _table(new, pool.unit, pool.center)


def _native_merge(pool: _Pool, pairs: Tensor, widen: bool) -> None:
    """The same as `_merge`, of Gaussians in float32 on the CPU."""
    splats = pool.splats
    face.merge_pairs(
        means=splats.means, scales=splats.scales, quats=splats.quats, opacities=splats.opacities,
        sh=splats.sh.flatten(1), table=pool.table, pairs=pairs, unit=pool.unit, center=pool.center, widen=int(widen),
    )  # fmt: skip


def _native_partners(pool: _Pool, near: float, wave: int) -> tuple[Tensor, Tensor]:
    """The same as `_partners`, of Gaussians in float32 on the CPU."""
    n, best = len(pool.order), pool.table.new_empty(len(pool.order))
    partner = torch.empty(n, dtype=torch.int64)
    face.merge_partners(
        table=pool.table, sh=pool.splats.sh.flatten(1), weights=pool.weights, order=pool.order, window=WINDOW,
        wave=wave, near=near, prices=pool.table.new_empty(n, WINDOW), best=best, partner=partner,
    )  # fmt: skip
    return best, partner


def _partners(pool: _Pool, near: float, wave: int) -> tuple[Tensor, Tensor]:
    """The price [n] of the cheapest neighbour of each place of the curve, infinite if none is near, and its place [n],
    then its own."""
    n, device = len(pool.order), pool.table.device
    best = torch.full((n,), math.inf, dtype=pool.table.dtype, device=device)
    places = torch.arange(n, device=device)
    partner = places.clone()
    rows = torch.cat([pool.order, pool.order[-1:].expand(WINDOW)])  # the last ones have as many neighbours
    columns, weights = pool.columns(rows), None if pool.weights is None else pool.weights[rows]
    step = _at_once(ROWS_AT_ONCE, best) // WINDOW
    for start in range(0, n, step):
        end = min(start + step, n)
        found = _prices_ahead(columns, weights, start, end, near, wave)
        for offset, price in enumerate(found, 1):
            price = price[: max(n - offset - start, 0)]
            for ours, theirs in ((start, start + offset), (start + offset, start)):
                here = slice(ours, ours + len(price))
                better = price < best[here]
                best[here] = torch.where(better, price, best[here])
                partner[here] = torch.where(better, places[theirs : theirs + len(price)], partner[here])
    return best, partner


def _prices_ahead(
    columns: Columns, weights: Tensor | None, start: int, end: int, near: float, wave: int
) -> Tensor:  # fmt: skip
    """Prices [WINDOW,n] of the places `start` to `end` of the curve with each of the next ones; infinite if far."""
    ahead = [slice(start + offset, end + offset) for offset in range(1, WINDOW + 1)]
    apart = torch.stack([(columns.rest[:, start:end] - columns.rest[:, some]).square().sum(dim=0) for some in ahead])
    alone = columns._replace(rest=columns.rest[:0])
    ours, others = alone.part(start, end), [alone.part(some.start, some.stop) for some in ahead]
    a = Columns(*(torch.cat([each] * WINDOW, dim=-1) for each in ours))
    b = Columns(*(torch.cat(each, dim=-1) for each in zip(*others, strict=True)))
    price = prices(a, b, apart.flatten()).nan_to_num(nan=3e38, posinf=3e38)
    price = torch.where(closeness(a, b) < near, price, math.inf).view(WINDOW, -1)
    if weights is not None:
        price = price * ((weights[start:end] + torch.stack([weights[some] for some in ahead])) / 2)
    rows = torch.arange(start, end, device=price.device)
    offset = torch.arange(1, WINDOW + 1, device=price.device)[:, None]
    # Equal prices, as of copies, would have all point the same way.
    return price * (1 + 1e-5 * _lot(rows, offset, wave)) + 1e-30 * _lot(rows, offset, wave + 1)


def _lot(rows: Tensor, offset: Tensor, wave: int) -> Tensor:
    """A number in 0..1 for each pair, as good as drawn and the same on every machine."""
    mixed = (rows * 2654435761 + offset * 40503 + wave * 97) & 0xFFFFFFFF
    mixed = ((mixed ^ (mixed >> 15)) * 2246822519) & 0xFFFFFFFF
    return ((mixed ^ (mixed >> 13)) & 0xFFFF).float() / 65535
