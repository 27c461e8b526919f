"""Fewer Gaussians for the same pictures: what matters least goes, then neighbours merge.

Each does half of it, by equal factors. Removals alone take away light, and it adds up; merging alone blurs what a
removal would hardly have changed. At half of the Gaussians both together are 2 to 3 dB better than removals alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from sw_gaussians.simplifying import merged_by

from splatwizard_core.api import GaussianModel
from sw_compress.pruning import Pruning
from sw_compress.rows import IMPORTANCE, like, select

PRUNED = 0.5
"""1: nothing merges. Power of the share of the Gaussians that stays when what matters least has gone."""
FAINTEST_WEIGHT = 1e-4
"""Of a Gaussian that is shown, in medians: prices of merging shall not be ruled by those that hardly are."""


@dataclass(frozen=True)
class Reduction:
    """A model with fewer Gaussians, however many are asked for.

    pruning     of that model
    """

    model: GaussianModel
    pruning: Pruning

    @torch.no_grad()
    def part(self, count: int) -> GaussianModel:
        """The model with `count` Gaussians, and what each weighs."""
        whole = self.model.num_rows
        if count >= whole:
            return self.model
        rows = self.pruning.rows(self._kept(count))
        found, weights = select(self.model, rows), self.pruning.importance[rows]
        if len(rows) > count and PRUNED < 1:  # at 1 more are left only where no others may go
            merged, weights = merged_by(found, count, self._weights()[rows])
            found = like(self.model, merged)
        setattr(found, IMPORTANCE, weights)
        return found

    def pruned(self, count: int) -> int:
        """How many were removed on the way to so many; the others that are not there have merged."""
        whole = self.model.num_rows
        return whole - len(self.pruning.rows(self._kept(count)))

    def _kept(self, count: int) -> int:
        whole = self.model.num_rows
        return max(count, round(whole * (count / whole) ** PRUNED))

    def _weights(self) -> torch.Tensor:
        """What each Gaussian weighs in pictures [N]; what none shows, and must not go, weighs as much as the median."""
        known = self.pruning.importance
        shown = known[known > 0]
        median = shown.median() if len(shown) else known.new_ones(())
        weights = known.clamp_min(FAINTEST_WEIGHT * float(median))
        unseen = self.pruning.unseen
        return torch.where(unseen, median, weights) if self.pruning.keeps_unseen else weights
