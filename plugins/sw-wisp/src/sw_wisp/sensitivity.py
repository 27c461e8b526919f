"""How much the pictures depend on each splat and on each number of one, over all training views.

Both measures are of the squared error. Removing a splat has an exact price, since a picture is affine in a factor on
its opacity (but for the clamp of alpha and the stop at opaque pixels). Everything else is the diagonal of the
Gauss-Newton matrix, from random signs: the square of the gradient of sum(signs x image) has it as its mean.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from splatwizard_core.api import RasterOptions, photometric_loss

if TYPE_CHECKING:
    from splatwizard_core.api import Rasterizer, SplatModel, View


@dataclass(frozen=True)
class Removal:
    """What the pictures lose by each splat's removal alone.

    squared_error   [N] float64: squared error over all pixels and colours after its removal, minus before. Below 0: the
                    pictures get better without it
    total_error     that error before
    loss            mean photometric loss of the views
    values          pixels x colours of all views
    """

    squared_error: Tensor
    total_error: float
    loss: float
    values: int

    @property
    def loss_rise(self) -> Tensor:
        """[N] float64: how much the photometric loss rises, to first order: it goes with the root of the error."""
        return self.squared_error * (self.loss / max(2 * self.total_error, 1e-30))


def removal_cost(
    model: SplatModel, views: Iterable[View], rasterizer: Rasterizer, background: Tensor, *, lambda_dssim: float = 0.2
) -> Removal:
    """Return the exact cost of removing each splat alone, over all `views` (each with its photograph).

    A pixel is affine in a factor m on the opacity, so the error changes by S - g with S = sum (dI/dm)^2 and
    g = dE/dm at m = 1. S is read off the rasterizer's sums of squared opacity gradients, one colour at a time.
    """
    device = background.device
    rise = torch.zeros(model.num_rows, dtype=torch.float64, device=device)
    error, loss, values, count = 0.0, 0.0, 0, 0
    options = RasterOptions(background=background, fragment_grad=True)
    for view in views:
        camera, truth = view.camera.to(device), view.image(background, device)
        with torch.no_grad():
            inputs = model.gaussians(camera, rasterizer)
        with torch.enable_grad():
            opacities = inputs.opacities.detach().requires_grad_()
            for colour in range(3):
                result = rasterizer.render(replace(inputs, opacities=opacities), camera, options)
                torch.autograd.grad(result.image[colour].sum(), opacities)  # fills the sums
                assert result.fragment_grad is not None
                rise += result.fragment_grad.value[:, 0].double()
            result = rasterizer.render(
                replace(inputs, opacities=opacities), camera, RasterOptions(background=background)
            )
            squared = (result.image - truth).square().sum()
            (slope,) = torch.autograd.grad(squared, opacities)
        rise -= (slope * opacities.detach()).double()
        error += squared.item()
        with torch.no_grad():
            loss += photometric_loss(result.image.detach(), truth, lambda_dssim=lambda_dssim).total.item()
        values, count = values + truth.numel(), count + 1
    return Removal(rise, error, loss / max(count, 1), values)


def squared_slopes(
    model: SplatModel,
    names: Sequence[str],
    views: Iterable[View],
    rasterizer: Rasterizer,
    background: Tensor,
    generator: torch.Generator,
    *,
    draws: int = 2,
) -> dict[str, Tensor]:
    """Return sum over pixels and colours of (dI/dz)^2 for every number z of the parameters `names`, in their shapes.

    generator   of the signs, on the CPU
    draws       signs per view; the relative error of one number is about sqrt(2 / (draws x views that see it))
    """
    parameters = [model.get_parameter(name) for name in names]
    sums = [torch.zeros_like(parameter) for parameter in parameters]
    options = RasterOptions(background=background)
    for view in views:
        camera = view.camera.to(background.device)
        for _ in range(draws):
            with torch.enable_grad():
                image = rasterizer.render(model.gaussians(camera, rasterizer), camera, options).image
                signs = torch.randint(0, 2, image.shape, generator=generator, dtype=torch.int8).to(image.device) * 2 - 1
                slopes = torch.autograd.grad((image * signs).sum(), parameters, allow_unused=True)
            for total, slope in zip(sums, slopes, strict=True):
                if slope is not None:
                    total += slope.square() / draws
    return dict(zip(names, sums, strict=True))
