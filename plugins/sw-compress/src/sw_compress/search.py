"""Choice of how many Gaussians stay and how precise they are: for a size, or a quality. Nothing is coded here."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from splatwizard_core.api import GaussianModel, UserInputError
from sw_compress.allocation import Allocation, Curve, at_levels, at_price, of_error, within
from sw_compress.coders import FIXED_BYTES, POSITIONS, Quantized
from sw_compress.measuring import Errors
from sw_compress.quality import Pictures, decibels
from sw_compress.rows import select
from sw_compress.stages import give_back
from sw_compress.targets import QUALITY_MARGIN

if TYPE_CHECKING:
    from sw_compress.reducing import Reduction

SHARES = (1.0, 0.8, 0.64, 0.5, 0.4, 0.3, 0.2, 0.14, 0.1, 0.05, 0.02)
"""Shares of the Gaussians that are tried, until it gets worse."""
PATIENCE = 2
"""Shares that may be worse than the best before the rest is left out."""
QUALITY_TRIES = 16
MEASURED = 2
"""Choices, the smallest by their estimates, that are brought to a quality: what pruning costs is roughly estimated."""
KEPT = 100_000
"""Gaussians up to which all parts that were looked at are kept."""
COARSEST_PRICE = 1e300


@dataclass
class Search:
    """Scene, codec and measurements of a search.

    pictures    of the source at cameras to choose with
    count       how many Gaussians stay; None: what is best
    tried       (gaussians, bytes estimated, dB against the source) of each that was drawn
    """

    coder: Quantized
    model: GaussianModel
    reduction: Reduction
    pictures: Pictures
    errors: Errors
    count: int | None = None
    tried: list[tuple[int, float, float]] = field(default_factory=list)
    _known: dict[int, tuple[GaussianModel, list[Curve]]] = field(default_factory=dict)
    _coarsest: tuple[float, int, list[Curve]] | None = None

    @property
    def is_tight(self) -> bool:
        """Whether parts are made anew once one is chosen: memory of a CPU is for one beside the model."""
        return self.model.device.type == "cpu" and self.model.num_rows > KEPT and len(self.parts()) > 1

    def parts(self) -> list[int]:
        """Numbers of Gaussians to try, falling."""
        return parts_of(self.model.num_rows, self.count)

    def part(self, count: int) -> tuple[GaussianModel, list[Curve]]:
        """The model with as many Gaussians as `count`, or as few as may stay, and its curves."""
        if count not in self._known:
            self.coder.forget()  # the part before, which is nearly as large as this one
            part = self.reduction.part(count)
            give_back()  # what drawing it held on to
            found = part, self.errors.curves(self.coder, part)
            if self.model.num_rows > KEPT:
                return found
            self._known[count] = found
        return self._known[count]

    def gaussians(self, count: int) -> GaussianModel:
        """The model of `part`."""
        return self._known[count][0] if count in self._known else self.reduction.part(count)

    def note_coarsest(self, count: int, curves: list[Curve]) -> None:
        """Remember what `part` gave for `count` at its coarsest, if nothing smaller is known."""
        size = at_price(curves, COARSEST_PRICE).bytes
        if self._coarsest is None or size < self._coarsest[0]:
            self._coarsest = size, count, curves

    @property
    def coarsest(self) -> Choice | None:
        """The smallest by the estimate of all that was looked at; its Gaussians are made anew, few searches need it."""
        if self._coarsest is None:
            return None
        _, count, curves = self._coarsest
        return Choice(self.gaussians(count), curves, at_price(curves, COARSEST_PRICE))


def parts_of(whole: int, count: int | None) -> list[int]:
    """Numbers of Gaussians to try, falling: `count` alone, or shares of the `whole`."""
    if count is not None:
        return [min(count, whole)]
    return sorted({max(1, round(share * whole)) for share in SHARES}, reverse=True)


@dataclass(frozen=True)
class Choice:
    """Gaussians to code, and their precision.

    model       the Gaussians that stay
    curves      of these
    allocation  levels, and what the tables say of them; bytes without the file's fixed ones
    """

    model: GaussianModel
    curves: list[Curve]
    allocation: Allocation

    @property
    def bytes(self) -> float:
        """Estimate of the file."""
        return self.allocation.bytes + FIXED_BYTES

    @property
    def is_finest(self) -> bool:
        """True where nothing can be more precise."""
        return all(self.allocation.levels[curve.name] == curve.levels[0] for curve in self.curves)

    def coarsest(self) -> Choice:
        """The same Gaussians as coarse as can be."""
        return replace(self, allocation=at_price(self.curves, COARSEST_PRICE))

    def placed(self) -> list[Curve]:
        """The curves with places as precise as here."""
        return [self._fixed(curve) if curve.name == POSITIONS else curve for curve in self.curves]

    def sized(self, sizes: Mapping[str, NDArray[np.float64]], share: float) -> Choice:
        """The choice with other bytes at all levels: a share of these."""
        curves = [curve.sized(share * sizes[curve.name]) for curve in self.curves]
        return replace(self, curves=curves, allocation=at_levels(curves, self.allocation.levels))

    def within(self, budget: float) -> Choice | None:
        """The same Gaussians in a file of `budget` bytes by the estimate."""
        found = within(self.curves, budget - FIXED_BYTES)
        return None if found is None else replace(self, allocation=found)

    def resized(self, budget: float) -> Choice | None:
        """The same Gaussians, places as precise as here, in a file of `budget` bytes by the estimate."""
        found = within(self.placed(), budget - FIXED_BYTES)
        return None if found is None else replace(self, allocation=found)

    def _fixed(self, curve: Curve) -> Curve:
        k = int(abs(curve.levels - self.allocation.levels[POSITIONS]).argmin())
        part = slice(k, k + 1)
        return Curve(curve.name, curve.levels[part], curve.bytes[part], curve.error[part], True)


def for_size(search: Search, budget: float) -> Choice | None:
    """The best picture in a file of an estimated `budget` bytes; None where nothing is so small."""
    best: tuple[int, list[Curve], Allocation] | None = None
    held: GaussianModel | None = None
    best_error, worse = math.inf, 0
    for count in search.parts():
        choice, error, last = _looked_at(search, count, budget)
        if choice is not None:
            if error < best_error:
                best, best_error, worse = (count, choice.curves, choice.allocation), error, 0
                held = None if search.is_tight else choice.model
            else:
                worse += 1
            choice = None  # its Gaussians go before the next ones are made
        if worse == PATIENCE or last:
            break
    if best is None:
        return None
    count, curves, allocation = best
    return Choice(search.gaussians(count) if held is None else held, curves, allocation)


def within_bytes(search: Search, count: int, budget: float) -> Choice | None:
    """The best picture of so many Gaussians in an estimated `budget` bytes; None where they take more."""
    part, curves = search.part(count)
    found = within(curves, budget - FIXED_BYTES)
    return None if found is None else Choice(part, curves, found)


def _looked_at(search: Search, count: int, budget: float) -> tuple[Choice | None, float, bool]:
    """The best that so many Gaussians give, its error, and whether no fewer may stay.

    Where memory is tight its model is rounded, and not to be coded.
    """
    part, curves = search.part(count)
    give_back()
    search.note_coarsest(count, curves)
    found = within(curves, budget - FIXED_BYTES)
    last = part.num_rows > 1.02 * count  # the rest may not go
    if found is None:
        return None, math.inf, last
    choice = Choice(part, curves, found)
    rounding, steps = search.coder.rounding(part), search.coder.whole_steps(found.levels)
    in_place = search.is_tight and part is not search.model
    rounded = rounding.overwrite(steps) if in_place else rounding.model_at(steps)
    del rounding
    search.coder.forget()  # what it rounds by is not needed to draw
    give_back()
    error = search.pictures.error(rounded)
    search.tried.append((part.num_rows, choice.bytes, decibels(error)))
    return choice, error, last


def check_in_reach(coder: Quantized, model: GaussianModel, count: int | None, size: int) -> None:
    """Raise UserInputError for less than half of `least_bytes`: no part that is worth more has so few."""
    least = least_bytes(coder, model, count)
    if least > 2 * size:
        raise too_small(size, f"about {least:,.0f}")


def least_bytes(coder: Quantized, model: GaussianModel, count: int | None) -> float:
    """Estimate the file of the fewest Gaussians as coarse as can be, evenly taken instead of the best.

    count   of Gaussians that stay; None: what is best
    """
    count = parts_of(model.num_rows, count)[-1]
    few = torch.arange(0, model.num_rows, max(1, model.num_rows // count))
    part = select(model, few.to(model.device)[:count])
    return FIXED_BYTES + sum(float(each[-1]) for each in coder.sizes(part, coarsest=True).values())


def too_small(size: int, smallest: str) -> UserInputError:
    """The error for a size out of reach."""
    return UserInputError(f"no file of {size:,} bytes was found: the smallest has {smallest} bytes")


def for_quality(search: Search, quality: float, held_out: Pictures) -> Choice:
    """The smallest estimate whose pictures at the cameras held out are as good as `quality`, dB.

    Raises UserInputError where the finest settings are not that good.
    """
    wanted = 10 ** (-quality / 10)
    found: list[Choice] = []
    for count in search.parts():
        part, curves = search.part(count)
        lost = search.pictures.error(search.coder.rounded(part, search.coder.finest(part)))
        if lost >= wanted and found:
            break
        allocation = of_error(curves, max(wanted - lost, 0.02 * wanted))
        found.append(Choice(part, curves, allocation))
        search.tried.append((part.num_rows, found[-1].bytes, decibels(lost + allocation.error)))
        best = min(range(len(found)), key=lambda i: found[i].bytes)
        if len(found) - 1 - best == PATIENCE or part.num_rows > 1.02 * count or lost >= wanted:
            break
    finest, good = -math.inf, list[Choice]()
    for choice in sorted(found, key=lambda each: each.bytes):
        reached, measured = _measured(search, choice, quality, held_out)
        good += [] if measured is None else [measured]
        finest = max(finest, reached)
        if len(good) == MEASURED:
            break
    if good:
        return min(good, key=lambda each: each.bytes)
    raise UserInputError(
        f"the finest settings reach {finest:.1f} dB against the source, which is less than {quality:g} dB"
    )


def measured_again(search: Search, choice: Choice, quality: float, held_out: Pictures) -> Choice:
    """The choice as coarse as the quality allows, or as it is."""
    return _measured(search, choice, quality, held_out)[1] or choice


def _measured(search: Search, choice: Choice, quality: float, held_out: Pictures) -> tuple[float, Choice | None]:
    """Return the dB reached last, and the choice made finer or coarser until it is as good as asked for, little better.

    None where its finest settings are not that good.
    """
    good: tuple[float, float, Choice] | None = None  # error by the tables, dB reached
    bad: tuple[float, float] | None = None
    wanted, haste, reached, curves = choice.allocation.error, 1.0, -math.inf, choice.curves
    for _ in range(QUALITY_TRIES):
        found = Choice(choice.model, choice.curves, of_error(curves, wanted))
        reached = held_out.quality(search.coder.rounded(found.model, found.allocation.levels)).psnr
        if reached >= quality:
            if good is None or found.bytes < good[2].bytes:
                good = wanted, reached, found
            if reached <= quality + QUALITY_MARGIN:
                break
        else:
            bad = wanted, reached
            if found.is_finest:
                break
        if good is not None and curves is choice.curves:  # a bit of the positions is a jump: the rest goes on from it
            curves, bad = good[2].placed(), None
        if good is not None and bad is not None:
            share = (quality + QUALITY_MARGIN / 2 - bad[1]) / max(good[1] - bad[1], 1e-6)
            wanted = bad[0] * (good[0] / bad[0]) ** min(max(share, 0.1), 0.9)
        else:  # part of the error may be of what was pruned, which no precision mends
            wanted *= 10 ** (haste * (reached - quality - QUALITY_MARGIN / 2) / 10)
            haste = min(2 * haste, 4.0)
    return reached, None if good is None else good[2]
