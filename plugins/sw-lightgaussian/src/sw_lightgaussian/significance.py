"""Pruner `lightgaussian`: how much light each Gaussian may catch over all training views, times a power of its volume.

Source: LightGaussian (arXiv 2311.17245), section on global significance, and facts about the authors' code.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

import torch
from pydantic import Field
from sw_gaussians.finetune.volume import VolumeNorm, volume_factor

from splatwizard_core.api import GaussianModel, Params, RasterOptions, ScoreSpec

if TYPE_CHECKING:
    from torch import Tensor

    from splatwizard_core.api import Camera, Rasterizer, SplatModel

Kind = Literal["v_important_score", "v_tile_score", "important_score", "max_v_important_score", "count", "opacity"]
TILE = 16
"""Pixels along the side of a tile of the published kernel."""


class SignificanceSettings(Params):
    """Settings of the pruner `lightgaussian`."""

    kind: Kind = Field("v_important_score", description="which score, see the README")
    v_pow: float = Field(0.1, ge=0, description="power of the volume")
    volume_norm: VolumeNorm = Field(
        "unclamped", description="as in the authors' code, or paper_clamp: relative to the 90th percentile, at most 1"
    )
    use_transmittance: bool = Field(True, description="False: the score of early versions of the paper")


class Significance:
    """Scores by name as in the authors' code; sums run over every pixel of every view that a Gaussian is blended into.

    kind                v_important_score: sum of opacity x transmittance, times (volume / reference)^v_pow;
                        v_tile_score: the same, but in each view its mean over the pixels counts as often as there are
                        tiles under a disc of so many pixels. The threads of a tile overwrite each other's sums in the
                        authors' kernel, so that about this is left, and large Gaussians get less by far;
                        important_score: that sum; max_v_important_score: it times the largest scale;
                        count: how many pixels; opacity: the opacity of what is seen at all
    v_pow               0: the volume does not count
    volume_norm         unclamped: the reference, a small volume, changes no order; paper_clamp: it is the 90th
                        percentile, and no ratio is above 1
    use_transmittance   False: the sum is of opacities alone (the scores of early versions of the paper)

    It is the opacity itself, not alpha: a hit at the rim of a splat counts as much as one at its centre.
    """

    Settings = SignificanceSettings
    uses_statistics = False

    def __init__(
        self,
        *,
        kind: Kind = "v_important_score",
        v_pow: float = 0.1,
        volume_norm: VolumeNorm = "unclamped",
        use_transmittance: bool = True,
    ) -> None:
        self.kind, self.v_pow, self.volume_norm, self.use_transmittance = kind, v_pow, volume_norm, use_transmittance

    def score(
        self, model: SplatModel, cameras: Sequence[Camera], rasterizer: Rasterizer, background: Tensor | None = None
    ) -> Tensor:
        """[N] float64 >= 0; -inf for what no camera sees. Raises TypeError for a model without Gaussians of its own."""
        if not isinstance(model, GaussianModel):
            raise TypeError(f"the pruner 'lightgaussian' scores a GaussianModel, not a {type(model).__name__}")
        hits, caught = self._sums(model, cameras, rasterizer, background)
        if self.kind == "count":
            found = hits
        elif self.kind == "opacity":
            found = model.opacities.detach().double()
        else:
            found = caught * self._factor(model.log_scales.detach().double())
        return torch.where(hits > 0, found, -torch.inf)

    def _factor(self, log_scales: Tensor) -> Tensor | float:
        """[N], what the sum is multiplied by."""
        if self.kind == "max_v_important_score":
            return log_scales.amax(dim=1).exp()
        if self.kind in ("v_important_score", "v_tile_score"):
            return volume_factor(log_scales, self.v_pow, self.volume_norm)
        return 1.0

    @torch.no_grad()
    def _sums(
        self, model: GaussianModel, cameras: Sequence[Camera], rasterizer: Rasterizer, background: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """[N] float64 each: pixels, and the sum of opacity x transmittance over them or over tiles, in all views."""
        kind = "opacity_T" if self.use_transmittance else "opacity"
        options = RasterOptions(background=background, scores=(ScoreSpec("hits", "hits"), ScoreSpec("caught", kind)))
        hits = torch.zeros(model.num_rows, dtype=torch.float64, device=model.device)  # whole numbers up to 2^53
        caught = torch.zeros(model.num_rows, dtype=torch.float64, device=model.device)
        for camera in cameras:
            camera = camera.to(model.device)
            # One view at a time: a rasterizer returns its sums as int32 and float32.
            view = rasterizer.accumulate(model.gaussians(camera, rasterizer), [camera], options).scores
            seen, share = view["hits"].double(), view["caught"].double()
            if self.kind == "v_tile_score":
                share = share * (tiles_under(seen) / seen.clamp_min(1))
            hits += seen
            caught += share
        return hits, caught


def tiles_under(pixels: Tensor) -> Tensor:
    """Tiles that a square as wide as a disc of so many `pixels` [N] touches on average over its places; 0 of none."""
    width = (pixels * (4 / math.pi)).sqrt()
    # A line of w pixels, w >= 1, touches (w - 1) / TILE + 1 tiles on average.
    return torch.where(pixels > 0, ((width - 1).clamp_min(0) / TILE + 1).square(), 0.0)
