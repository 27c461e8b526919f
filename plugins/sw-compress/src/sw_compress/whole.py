"""All of a large scene with fewer Gaussians, drawn without higher spherical harmonics.

A sample of it does not tell what that costs: whatever goes takes light away, and along a ray through many Gaussians the
errors add up, where those of rounding have no common sign.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from sw_gaussians.simplifying import merged_by
from torch import Tensor

from splatwizard_core.api import Camera, GaussianModel, RasterOptions
from sw_compress.large_scene import Curve, LargeScene
from sw_compress.pruning import Pruning
from sw_compress.quality import Pictures
from sw_compress.reducing import Reduction
from sw_compress.rows import like, select
from sw_compress.stages import give_back

if TYPE_CHECKING:
    from splatwizard_core.api import Rasterizer


class Whole:
    """Parts of a scene by their number of Gaussians.

    pruning     of its `light`
    cameras     that choose
    """

    def __init__(self, scene: LargeScene, pruning: Pruning, cameras: Sequence[Camera], rasterizer: Rasterizer) -> None:
        self.scene, self._pruning = scene, pruning
        self._reduction = Reduction(scene.light, pruning)
        self._pictures = Pictures(scene.light, cameras, rasterizer, RasterOptions(alpha=True))
        self._known: dict[tuple[int, float], tuple[list[int], float]] = {}

    @property
    def weights(self) -> Tensor:
        """Of each Gaussian [N], by which prices of merging are multiplied."""
        return self._reduction.weights()

    @property
    def importance(self) -> Tensor:
        """Of each Gaussian [N] in pictures."""
        return self._pruning.importance

    def rows(self, count: int, power: float) -> Tensor:
        """Rows [M], ascending, that removals leave where `count` shall be left in the end."""
        whole = self.scene.num_rows
        return self._pruning.rows(self._reduction.kept(count, power) if count < whole else whole)

    def lost(self, count: int, power: float) -> float:
        """Error of the pictures with so many."""
        return self._reduced(count, power)[1]

    def counts(self, count: int, power: float) -> list[int]:
        """Gaussians of each tile, at most, after neighbours have merged: as many as if the whole merged at once."""
        return self._reduced(count, power)[0]

    @torch.no_grad()
    def _reduced(self, count: int, power: float) -> tuple[list[int], float]:
        if (count, power) not in self._known:
            scene, rows = self.scene, self.rows(count, power)
            give_back()
            found: GaussianModel
            if count < len(rows) and power < 1:
                found = like(scene.light, merged_by(scene.light, rows, count, self.weights[rows])[0])
                curve = Curve(scene.light.means.detach(), scene.limits[:-1])
                parts = curve.parts(found.means.detach())
                counts = torch.bincount(parts, minlength=len(scene.tiles)).tolist()
            else:
                found = scene.light if len(rows) == scene.num_rows else select(scene.light, rows)
                counts = [scene.num_rows for _ in scene.tiles]
            give_back()
            self._known[count, power] = counts, self._pictures.error(found)
        return self._known[count, power]
