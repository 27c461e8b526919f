"""Pruner `trimgs`: the mean of alpha times transmittance over a Gaussian's pixels, in the views that show most of it.

Source: Trim 3D Gaussian Splatting (arXiv 2406.07499), section on contribution-based trimming.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

import torch
from pydantic import Field
from sw_gaussians.surfels import SurfelModel

from splatwizard_core.api import ConfigError, GaussianModel, Params, RasterOptions, ScoreSpec
from sw_trimgs.surfel_contribution import blended, footprint

if TYPE_CHECKING:
    from torch import Tensor

    from splatwizard_core.api import Camera, Rasterizer, SplatModel

Count = Literal["tested", "blended"]
Top = Literal["largest", "shift"]
EPSILON = 1e-6
"""Added to the number of pixels, as published."""


class ContributionSettings(Params):
    """Settings of the pruner `trimgs`."""

    gamma: float = Field(0.5, ge=0, le=1, description="g in alpha^2g T^(2 - 2g); 0.5: alpha times transmittance")
    views: int = Field(5, ge=1, description="how many of a Gaussian's views count: those with the highest values")
    count: Count = Field(
        "tested", description="pixels: all with alpha of 1/255 or more, or only those that it is blended into"
    )
    top: Top = Field(
        "largest", description="shift: a value enters only if it beats the highest so far, as in the authors' code"
    )


class Contribution:
    """Scores by what a Gaussian adds to a pixel, on the average over its pixels of the views that show most of it.

    gamma   g in alpha^2g T^(2 - 2g); 0.5: alpha times transmittance
    views   K: the mean is over the K highest values of all views, or over all if there are fewer
    count   tested: pixels where alpha is at least 1/255, that which saturates the pixel included; blended: without it
    top     shift: all slots start with the first view, and a value enters only if it beats the highest

    The authors' kernels count every pixel of the tiles that a splat touches, up to 256 a tile, which makes the values
    of small splats smaller; here the footprint counts, whatever the tiles are. That of surfels is taken from their
    outline (surfel_contribution.py), for gamma 0.5 alone.
    """

    Settings = ContributionSettings
    uses_statistics = False

    def __init__(self, *, gamma: float = 0.5, views: int = 5, count: Count = "tested", top: Top = "largest") -> None:
        self.gamma, self.views, self.count, self.top = gamma, views, count, top

    @torch.no_grad()
    def score(
        self, model: SplatModel, cameras: Sequence[Camera], rasterizer: Rasterizer, background: Tensor | None = None
    ) -> Tensor:
        """[N] float32 in 0..1; -inf for what no camera sees. Raises TypeError for a model without own Gaussians."""
        if not isinstance(model, GaussianModel):
            raise TypeError(f"the pruner 'trimgs' scores a GaussianModel, not a {type(model).__name__}")
        best = BestViews(self.views, shift=self.top == "shift")
        for camera in cameras:
            best.add(self.of_view(model, camera.to(model.device), rasterizer, background))
        found = best.mean(model.means.new_zeros(model.num_rows))
        return torch.where(found > 0, found, -torch.inf)

    def of_view(
        self, model: GaussianModel, camera: Camera, rasterizer: Rasterizer, background: Tensor | None
    ) -> Tensor:
        """[N] float32, the mean over the pixels of one view; 0 for what it does not show.

        Raises ConfigError for surfels and another gamma than 0.5.
        """
        if model.NUM_SCALES == SurfelModel.NUM_SCALES:
            if self.gamma != 0.5:
                raise ConfigError(f"gamma of the pruner 'trimgs' is {self.gamma}; for surfels it can only be 0.5")
            return blended(model, camera, rasterizer) / (footprint(model, camera) + EPSILON)
        specs = (
            ScoreSpec("sum", "gamma", rule=self.count, gamma=self.gamma),
            ScoreSpec("pixels", "hits", rule=self.count),
        )
        options = RasterOptions(background=background, scores=specs)
        found = rasterizer.accumulate(model.gaussians(camera, rasterizer), [camera], options).scores
        return found["sum"] / (found["pixels"] + EPSILON)


class BestViews:
    """The mean of the K highest values of each row, over views that come one by one; O(K N) memory.

    slots   K
    shift   as in the authors' code: the first view fills all slots; a later value that beats the highest so far
            goes in front of it and the last one falls out, any other is lost
    """

    def __init__(self, slots: int, *, shift: bool = False) -> None:
        self.slots, self.shift = slots, shift
        self._kept: Tensor | None = None  # [N, at most K], descending

    def add(self, values: Tensor) -> None:
        """Take the values [N] of another view."""
        new = values[:, None]
        if self._kept is None:
            self._kept = new.repeat(1, self.slots) if self.shift else new
        elif self.shift:
            moved = torch.cat([new, self._kept[:, :-1]], dim=1)
            self._kept = torch.where(new > self._kept[:, :1], moved, self._kept)
        else:
            every = torch.cat([self._kept, new], dim=1)
            self._kept = every.topk(min(self.slots, every.shape[1]), dim=1).values

    def mean(self, default: Tensor) -> Tensor:
        """[N]; `default` if there was no view."""
        return default if self._kept is None else self._kept.mean(dim=1)
