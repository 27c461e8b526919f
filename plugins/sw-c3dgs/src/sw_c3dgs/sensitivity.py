"""Sensitivity: by how much the training pictures change when a colour, or a shape, changes. And the pruner of it.

Source: C3DGS (arXiv 2401.02436), section on parameter sensitivity.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

import torch
from pydantic import Field
from torch import Tensor

from splatwizard_core.api import SH, GaussianInputs, GaussianModel, Params, RasterOptions, track
from sw_c3dgs.shapes import normalised_covariances, split_scales

if TYPE_CHECKING:
    from splatwizard_core.api import Camera, Rasterizer, SplatModel

Kind = Literal["color", "shape"]


def sensitivities(
    cameras: Sequence[Camera],
    rasterizer: Rasterizer,
    *,
    means: Tensor,
    opacities: Tensor,
    log_factors: Tensor,
    shapes: Tensor,
    quats: Tensor,
    sh_dc: Tensor,
    sh_rest: Tensor,
) -> tuple[Tensor, Tensor]:
    """Sensitivity of each Gaussian's colour, and of its normalised covariance, [N] float32 >= 0 both.

    Of a number p it is sum_v |d E_v / d p| / sum_v pixels_v over the views v, where E_v is the sum over all pixels and
    channels of the render on black, its colours not clamped. That of a colour is the largest of its SH coefficients',
    all bands active; that of a shape the largest of the six entries'. 0 for what no view shows.

    means [N,3], opacities [N] in 0..1, log_factors [N], shapes [N,3] of unit length, quats [N,4], sh_dc [N,1,3],
    sh_rest [N,K-1,3]: the Gaussians; they get no gradient, one backward pass a view goes to copies
    """
    detached = [each.detach() for each in (means, opacities, log_factors, shapes, quats)]
    means, opacities, log_factors, shapes, quats = detached
    size = torch.exp(2 * log_factors)[:, None]
    with torch.enable_grad():
        leaves = [sh_dc.detach().clone(), sh_rest.detach().clone(), normalised_covariances(shapes, quats)]
        dc, rest, shape = (leaf.requires_grad_(True) for leaf in leaves)
    sums = [torch.zeros_like(leaf) for leaf in (dc, rest, shape)]
    asked = [dc, rest, shape] if rest.shape[1] else [dc, shape]
    into = sums if rest.shape[1] else [sums[0], sums[2]]
    degree = math.isqrt(1 + rest.shape[1]) - 1
    options, pixels = RasterOptions(clamp_color=False), 0
    with track("sensitivity", total=len(cameras)) as bar:
        for camera in cameras:
            camera = camera.to(means.device)
            with torch.enable_grad():
                colors = SH(dc=dc, rest=rest if rest.shape[1] else None, active_degree=degree)
                drawn = GaussianInputs(means=means, opacities=opacities, cov3d=shape * size, sh=colors)
                image = rasterizer.render(drawn, camera, options).image
                # The absolute value is taken of each view's gradient, not of their sum.
                gradients = torch.autograd.grad(image.sum(), asked)
            for total, gradient in zip(into, gradients, strict=True):
                total += gradient.abs_()
            pixels += camera.width * camera.height
            bar.advance(1)
    color = torch.cat([sums[0], sums[1]], 1).flatten(1).amax(1)
    return color / max(pixels, 1), sums[2].amax(1) / max(pixels, 1)


class SensitivitySettings(Params):
    """Settings of the pruner `sensitivity`."""

    kind: Kind = Field(
        "color", description="color: the largest derivative by an SH coefficient; shape: by an entry of the covariance"
    )


class Sensitivity:
    """Pruner `sensitivity`: how much the training pictures change with a Gaussian's colour, or with its shape.

    kind    color: the largest derivative by an SH coefficient; shape: by an entry of the covariance of trace 1
    """

    Settings = SensitivitySettings
    uses_statistics = False

    def __init__(self, *, kind: Kind = "color") -> None:
        self.kind = kind

    def score(
        self, model: SplatModel, cameras: Sequence[Camera], rasterizer: Rasterizer, background: Tensor | None = None
    ) -> Tensor:
        """[N] float32 >= 0, 0 for what no camera sees; pictures are on black, whatever the background.

        Raises TypeError for a model without Gaussians of its own.
        """
        if not isinstance(model, GaussianModel):
            raise TypeError(f"the pruner 'sensitivity' scores a GaussianModel, not a {type(model).__name__}")
        log_factors, shapes = split_scales(model.log_scales)
        color, shape = sensitivities(
            cameras, rasterizer, means=model.means, opacities=model.opacities, log_factors=log_factors, shapes=shapes,
            quats=model.quats, sh_dc=model.sh_dc, sh_rest=model.sh_rest,
        )  # fmt: skip
        return color if self.kind == "color" else shape
