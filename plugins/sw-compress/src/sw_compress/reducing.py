"""Fewer Gaussians for the same pictures: what matters least goes, then neighbours merge.

Removals alone take away light, and it adds up; merging alone blurs what a removal would hardly have changed. How much
is done by each is chosen by pictures: the fewer stay, the more merge.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import torch
from sw_gaussians.simplifying import merged_by

from splatwizard_core.api import GaussianModel
from sw_codecs.models.quantized import FAINTEST
from sw_compress.rows import IMPORTANCE, like, select
from sw_compress.stages import give_back

if TYPE_CHECKING:
    from sw_compress.pruning import Pruning
    from sw_compress.quality import Pictures

POWERS = (1.0, 0.75, 0.5, 0.25)
"""Power of the share of the Gaussians that is left by removals, in the order of trying; 1: nothing merges."""
FAINTEST_WEIGHT = 1e-4
"""Of a Gaussian that is shown, in medians: prices of merging shall not be ruled by those that hardly are."""


@dataclass
class Reduction:
    """A model with fewer Gaussians, however many are asked for.

    pruning     of that model
    pictures    of its source, that choose; None: the first of the powers is taken
    """

    model: GaussianModel
    pruning: Pruning
    pictures: Pictures | None = None
    _chosen: dict[int, int] = field(default_factory=dict)

    @torch.no_grad()
    def part(self, count: int) -> GaussianModel:
        """The model with `count` Gaussians, or without merging as few as may stay, and what each weighs."""
        if count >= self.model.num_rows:
            return self.model
        place, known = self._place(count), count in self._chosen
        found: GaussianModel | None = self._by(count, POWERS[place])
        if self.pictures is not None and not known:
            assert found is not None
            error = self.pictures.error(found) if found.num_rows <= count else math.inf  # the others may not go
            for trial in range(place + 1, len(POWERS)):
                found = None  # one is in memory at a time: each is nearly as large as the model
                found = self._by(count, POWERS[trial])
                changed = self.pictures.error(found)
                if changed >= error:
                    found = None
                    break
                error, place = changed, trial
        self._chosen[count] = place
        return self._by(count, POWERS[place]) if found is None else found

    def pruned(self, count: int) -> int:
        """Count those removed to come to so many; the others that are gone have merged."""
        kept = self.kept(count, self.power(count))
        return self.model.num_rows - len(self.pruning.rows(kept))

    def power(self, count: int) -> float:
        """The power that was chosen for so many, or for the next larger number."""
        return POWERS[self._place(count)]

    def _place(self, count: int) -> int:
        """Place of the power that was chosen for so many, or for the next larger number."""
        more = [each for each in self._chosen if each >= count]
        return self._chosen[min(more)] if more else 0

    def kept(self, count: int, power: float) -> int:
        """Count those that removals leave; the rest of what is too many merges."""
        whole = self.model.num_rows
        return max(count, round(whole * (count / whole) ** power))

    def _by(self, count: int, power: float) -> GaussianModel:
        rows = self.pruning.rows(self.kept(count, power))
        give_back()  # what drawing holds on to
        if len(rows) > count and power < 1:
            # Of some that merged so little is left that nothing is drawn.
            merged, weights = merged_by(
                self.model, rows, count, self.weights()[rows], summed=self.pruning.importance[rows], faintest=FAINTEST
            )
            if merged.sh_rest.untyped_storage().nbytes() > merged.sh_rest.nbytes:  # memory of all that merged
                give_back()
                merged.sh_rest.data = merged.sh_rest.clone()
            found = like(self.model, merged)
        else:
            found, weights = select(self.model, rows), self.pruning.importance[rows]
        setattr(found, IMPORTANCE, weights)
        give_back()
        return found

    def weights(self) -> torch.Tensor:
        """Weights of the Gaussians in pictures [N]; of what none shows, and must not go, as much as the median."""
        known = self.pruning.importance
        shown = known[known > 0]
        median = shown.median() if len(shown) else known.new_ones(())
        weights = known.clamp_min(FAINTEST_WEIGHT * float(median))
        return torch.where(self.pruning.unseen, median, weights) if self.pruning.keeps_unseen else weights
