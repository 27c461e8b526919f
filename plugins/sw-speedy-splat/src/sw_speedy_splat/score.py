"""The score: how much the rendered pictures change with a Gaussian's value at each pixel.

For a pixel of colour C and a Gaussian of value g there (alpha = opacity g), dC/dg = opacity T (colour - what is
behind). The score is the square of the derivative of R + G + B, summed over pixels and views: the Fisher information of
g, as PUP 3D-GS has it of mean and scale, up to a logarithm that changes no order. No photograph is looked at.

Source: Speedy-Splat (arXiv 2412.00578).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Literal

import torch
from pydantic import Field
from sw_reference.spherical_harmonics import sh_colors
from torch import Tensor

from splatwizard_core.api import GaussianModel, Params, RasterOptions, ScoreSpec

if TYPE_CHECKING:
    from splatwizard_core.api import Camera, GaussianInputs, Rasterizer, SplatModel

SPECS = (ScoreSpec("grad_sq", "grad_sq"), ScoreSpec("hits", "hits"))


class SpeedySettings(Params):
    """Settings of the pruner `speedy-splat`."""

    channel_mode: Literal["sum", "per_channel"] = Field(
        "sum", description="square the derivative of R + G + B, as published, or of each channel (three times the work)"
    )


class SpeedyScore:
    """Pruner `speedy-splat`.

    channel_mode    "sum": of the derivative of R + G + B, as published, in which +red and -blue cancel;
                    "per_channel": the squares of the three derivatives, added
    """

    Settings = SpeedySettings
    uses_statistics = False

    def __init__(self, channel_mode: Literal["sum", "per_channel"] = "sum") -> None:
        self.channel_mode = channel_mode

    @torch.no_grad()
    def score(
        self, model: SplatModel, cameras: Sequence[Camera], rasterizer: Rasterizer, background: Tensor | None = None
    ) -> Tensor:
        """[N] float32; -inf for what no pixel of any view is blended with.

        Raises TypeError for a model whose rows are not what is drawn.
        """
        if not isinstance(model, GaussianModel):
            raise TypeError(f"the pruner 'speedy-splat' scores a GaussianModel, not a {type(model).__name__}")
        total = torch.zeros(model.num_rows, device=model.device, dtype=torch.float64)
        seen = torch.zeros(model.num_rows, device=model.device, dtype=torch.bool)
        for g, views, behind in self._renders(model, cameras, rasterizer, background):
            found = rasterizer.accumulate(g, views, RasterOptions(background=behind, scores=SPECS)).scores
            total += found["grad_sq"]
            seen |= found["hits"] > 0
        return torch.where(seen, total, -torch.inf).float()

    def _renders(
        self, model: GaussianModel, cameras: Sequence[Camera], rasterizer: Rasterizer, background: Tensor | None
    ) -> Iterator[tuple[GaussianInputs, Sequence[Camera], Tensor | None]]:
        """(what is drawn, from where, on which background) for each sum of squares."""
        if not cameras:
            return
        cameras = [camera.to(model.device) for camera in cameras]
        if self.channel_mode == "sum":
            yield model.gaussians(cameras[0], rasterizer), cameras, background
            return
        for camera in cameras:
            g = model.gaussians(camera, rasterizer)
            colors = g.colors
            if colors is None:
                assert g.sh is not None
                colors = sh_colors(g.sh, camera.center, g.means)
            for one in torch.eye(3, device=model.device):  # with one channel left, the sum is that channel
                behind = None if background is None else background * one
                yield replace(g, sh=None, colors=colors * one), [camera], behind
