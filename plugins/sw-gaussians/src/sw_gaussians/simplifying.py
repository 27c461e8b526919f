"""Fewer Gaussians for the same scene: the cheapest pairs of neighbours merge, wave after wave.

In each wave every Gaussian points at its cheapest neighbour along a space-filling curve; pairs that point at each other
merge, the cheapest first. Prices are those of `merge_costs`, and are found anew for each wave.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch
from torch import Tensor

from splatwizard_core.api import GaussianModel
from sw_gaussians import face
from sw_gaussians.made_up_cameras import extent_of
from sw_gaussians.merge_costs import closeness, columns_of, prices
from sw_gaussians.merging import Splats, merge_groups, model_of, splats_of
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
CELLS = 20
"""Bits of a coordinate along the curve."""
ROWS_AT_ONCE = {"cpu": 1 << 14, "cuda": 1 << 22}
"""Pairs whose prices are found together: intermediate columns stay in the cache of a core."""


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
    return _reduced(model, count, significance, widen)[0]


@torch.no_grad()
def merged_by(model: GaussianModel, count: int, significance: Tensor) -> tuple[GaussianModel, Tensor]:
    """As `merged_to`, with the significance of each Gaussian of the result: the sum over what it stands for."""
    merged, weights = _reduced(model, count, significance, widen=False)
    assert weights is not None  # they were given
    return merged, weights.to(significance) * significance.median().clamp_min(1e-30)


def _reduced(
    model: GaussianModel, count: int, significance: Tensor | None, widen: bool
) -> tuple[GaussianModel, Tensor | None]:
    splats = splats_of(model)
    weights = None if significance is None else (significance / significance.median().clamp_min(1e-30)).to(splats.means)
    unit = _unit(splats)
    near, wave = NEAR, 0
    while (n := len(splats.means)) > max(count, 1):
        order = _curve(splats.means, wave)
        splats, weights = splats.rows(order), None if weights is None else weights[order]
        pairs = _wave(splats, weights, unit, near, wave)
        pairs = pairs[: min(n - count, math.ceil(TAKEN * len(pairs)))]
        if len(pairs) < min(ENOUGH * n, n - count):
            near *= 4
        splats, weights = _merged(splats, weights, pairs, widen)
        wave += 1
    return model_of(splats, model), weights


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
    """Size of the scene: the radius that holds half of what is visible."""
    sizes = splats.scales.double().sort(dim=1, descending=True).values
    areas = splats.opacities.double() * sizes[:, 0] * sizes[:, 1]
    points, weights, widths = (values.cpu().numpy() for values in (splats.means.double(), areas, sizes[:, 0]))
    return extent_of(points, weights, widths).r50


def _curve(points: Tensor, wave: int) -> Tensor:
    """Rows along a Morton curve whose cells are shifted in every wave: no border between two stays one."""
    low = points.amin(dim=0).double()
    side = (points.amax(dim=0).double() - low).max().clamp_min(1e-30)
    shift = torch.tensor([(wave * step) % 1 for step in (0.618034, 0.754878, 0.569840)], device=points.device)
    cells = (((points.double() - low) / side + shift) / 2 * (2**CELLS - 1)).long()
    return torch.argsort(interleave(cells), stable=True)


def _wave(splats: Splats, weights: Tensor | None, unit: float, near: float, wave: int) -> Tensor:
    """Pairs [P,2] of rows that are each other's cheapest neighbours, the cheapest first."""
    native = splats.means.device.type == "cpu" and splats.means.dtype == torch.float32 and GAUSSIANS.try_load()
    best, partner = (_native_partners if native else _partners)(splats, weights, unit, near, wave)
    rows = torch.arange(len(best), device=best.device)
    first = rows[(partner > rows) & (partner[partner] == rows)]
    first = first[torch.argsort(best[first], stable=True)]
    return torch.stack([first, partner[first]], dim=1)


def _native_partners(
    splats: Splats, weights: Tensor | None, unit: float, near: float, wave: int
) -> tuple[Tensor, Tensor]:
    """The same as `_partners`, of Gaussians in float32 on the CPU."""
    columns = columns_of(splats._replace(sh=splats.sh[:, :1]), unit)
    single = (columns.volumes[None], columns.masses[None], columns.opacities[None])
    table = torch.cat([columns.places, columns.six, *single, columns.colors]).T.contiguous()
    n, best = len(table), table.new_empty(len(table))
    partner = torch.empty(n, dtype=torch.int64)
    face.merge_partners(
        table=table, sh=splats.sh.flatten(1).contiguous(), weights=weights, window=WINDOW, wave=wave, near=near,
        prices=table.new_empty(n, WINDOW), best=best, partner=partner,
    )  # fmt: skip
    return best, partner


def _partners(splats: Splats, weights: Tensor | None, unit: float, near: float, wave: int) -> tuple[Tensor, Tensor]:
    """The price [N] of the cheapest neighbour of each row, infinite if none is near, and its row [N], then its own."""
    columns = columns_of(splats, unit)
    n, device = len(columns.opacities), columns.places.device
    best = torch.full((n,), math.inf, dtype=columns.places.dtype, device=device)
    partner = torch.arange(n, device=device)
    step = ROWS_AT_ONCE["cpu" if device.type == "cpu" else "cuda"]
    for start in range(0, n, step):
        for offset in range(1, WINDOW + 1):
            end = min(start + step, n - offset)
            if end <= start:
                break
            a, b = columns.part(start, end), columns.part(start + offset, end + offset)
            price = prices(a, b).nan_to_num(nan=3e38, posinf=3e38)
            rows = torch.arange(start, end, device=device)
            if weights is not None:
                price = price * (weights[start:end] + weights[start + offset : end + offset]) / 2
            # Equal prices, as of copies, would have all point the same way.
            price = price * (1 + 1e-5 * _lot(rows, offset, wave)) + 1e-30 * _lot(rows, offset, wave + 1)
            price = torch.where(closeness(a, b) < near, price, math.inf)
            for ours, theirs in ((rows, rows + offset), (rows + offset, rows)):
                here = slice(int(ours[0]), int(ours[-1]) + 1)
                better = price < best[here]
                best[here] = torch.where(better, price, best[here])
                partner[here] = torch.where(better, theirs, partner[here])
    return best, partner


def _lot(rows: Tensor, offset: int, wave: int) -> Tensor:
    """A number in 0..1 for each pair, as good as drawn and the same on every machine."""
    mixed = (rows * 2654435761 + offset * 40503 + wave * 97) & 0xFFFFFFFF
    mixed = ((mixed ^ (mixed >> 15)) * 2246822519) & 0xFFFFFFFF
    return ((mixed ^ (mixed >> 13)) & 0xFFFF).float() / 65535


def _merged(splats: Splats, weights: Tensor | None, pairs: Tensor, widen: bool) -> tuple[Splats, Tensor | None]:
    left = torch.ones(len(splats.means), dtype=torch.bool, device=pairs.device)
    left[pairs.flatten()] = False
    new = merge_groups(splats.rows(pairs), widen=widen).to(splats.means.dtype)
    splats = Splats(*(torch.cat([old[left], more]) for old, more in zip(splats, new, strict=True)))
    if weights is not None:
        weights = torch.cat([weights[left], weights[pairs].sum(dim=1)])
    return splats, weights
