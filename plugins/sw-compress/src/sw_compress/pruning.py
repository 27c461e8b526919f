"""The order in which Gaussians may go: each time those whose removal changes the pictures least.

Removals in one place add coherently, since what they take away is always light: so few go at once, few of them
neighbours, and what is left is judged anew.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import torch
from sw_gaussians.morton import ROWS_AT_ONCE, interleave
from sw_gaussians.removal import removal_costs
from torch import Tensor

from splatwizard_core.api import Camera, track
from sw_compress.rows import select
from sw_compress.stages import give_back

if TYPE_CHECKING:
    from splatwizard_core.api import Rasterizer
    from splatwizard_core.tooling import Bar

ROUND_SHARE = 0.15
"""Largest share of the Gaussians that goes in one round."""
NEIGHBOURS, AT_ONCE = 16, 4
"""Of so many neighbours in Morton order, so many go at most in one round."""
ROUNDS_PER_SCORE = 2
SEEN = 1 / 255
"""Largest weight in any pixel below which a Gaussian counts as not seen."""


class Pruning:
    """Removals in order, made as far as they are asked for: what `rows` returns for fewer is a part of that for more.

    model           a GaussianModel, or another whose rows are what is drawn, with `means`
    cameras         that judge
    keeps_unseen    whether Gaussians that none of them shows stay: cameras that were made up prove nothing; else they
                    go first
    select          the model with some rows alone
    """

    def __init__(
        self, model: Any, cameras: Sequence[Camera], rasterizer: Rasterizer, *, keeps_unseen: bool = True,
        select: Callable[[Any, Tensor], Any] = select,
    ) -> None:  # fmt: skip
        self._model, self._cameras, self._rasterizer, self._select = model, list(cameras), rasterizer, select
        self.keeps_unseen = keeps_unseen
        self._left = torch.arange(model.num_rows, device=model.device)
        self._gone: list[Tensor] = []
        self._costs, self._age = torch.zeros(0), ROUNDS_PER_SCORE
        self._importance, self._unseen = torch.zeros(0), torch.zeros(0, dtype=torch.bool)

    @property
    def unseen(self) -> Tensor:
        """Whether no camera shows a Gaussian [N]."""
        self._judged()
        return self._unseen

    @property
    def importance(self) -> Tensor:
        """Squared change of the pictures by that of a colour, of each Gaussian [N] while all are there."""
        self._judged()
        return self._importance

    def _judged(self) -> None:
        if self._age == ROUNDS_PER_SCORE and not self._gone:
            self._score()

    def rows(self, count: int) -> Tensor:
        """Rows [M] int64, ascending, that are left where `count` shall be; more where the others may not go."""
        while len(self._left) > count and self._round(len(self._left) - count):
            pass
        removed = self._model.num_rows - count
        gone = torch.cat([*self._gone, self._left[:0]])[: max(removed, 0)]
        kept = torch.ones(self._model.num_rows, dtype=torch.bool, device=self._model.device)
        kept[gone] = False
        return kept.nonzero().squeeze(1)

    def _round(self, wanted: int) -> bool:
        """Remove some, `wanted` at most; False where none may go."""
        if self._age == ROUNDS_PER_SCORE:
            self._score()
        self._age += 1
        allowed = min(wanted, max(1, int(ROUND_SHARE * len(self._left))))
        order = torch.sort(self._costs, stable=True).indices
        unseen = int((self._costs < 0).sum())
        if unseen:  # they change nothing, however many go
            order = order[: min(wanted, unseen)]
        else:
            order = order[self._among_neighbours(order) < AT_ONCE]
            order = order[self._costs[order].isfinite()][:allowed]
        if not len(order):
            return False
        self._gone.append(self._left[order])
        stays = torch.ones(len(self._left), dtype=torch.bool, device=self._left.device)
        stays[order] = False
        self._left, self._costs = self._left[stays], self._costs[stays]
        return True

    def _score(self) -> None:
        """Judge what is left: infinite for what may not go, below zero for what is not seen and may."""
        give_back()
        part = self._model if not self._gone else self._select(self._model, self._left)
        with track(f"judge {len(self._left):,} Gaussians", total=len(self._cameras), unit="views") as bar:
            costs = removal_costs(
                lambda camera: part.gaussians(camera.to(part.device), self._rasterizer),
                _counted(self._cameras, bar), self._rasterizer, also=("blend_max", "blend_sq"),
            )  # fmt: skip
        unseen = costs.scores["blend_max"] < SEEN
        if not self._gone:
            self._importance, self._unseen = costs.scores["blend_sq"], unseen
        self._costs = torch.where(unseen, torch.inf if self.keeps_unseen else -1.0, costs.change)
        self._age = 0

    def _among_neighbours(self, order: Tensor) -> Tensor:
        """Count those of the same block of neighbours that come before each of `order` [n] in it."""
        means = self._model.means.detach()[self._left]
        low, high = means.amin(0).double(), means.amax(0).double()
        units = ((part.double() - low) / (high - low).clamp_min(1e-30) for part in means.split(ROWS_AT_ONCE))
        along = torch.cat([interleave((unit * ((1 << 20) - 1)).long()) for unit in units]).argsort(stable=True)
        block = torch.empty_like(along)
        block[along] = torch.arange(len(along), device=along.device) // NEIGHBOURS
        by_block = torch.sort(block[order], stable=True)
        first = torch.searchsorted(by_block.values, by_block.values)
        place = torch.empty_like(order)
        place[by_block.indices] = torch.arange(len(order), device=order.device) - first
        return place


def _counted(cameras: list[Camera], bar: Bar) -> Iterator[Camera]:
    for camera in cameras:
        yield camera
        bar.advance()
