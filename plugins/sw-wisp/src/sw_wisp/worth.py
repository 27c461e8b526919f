"""Worth of each splat to the pictures, in units of the loss."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from sw_gaussians.removal import removal_costs, sensitivities
from torch import Tensor

from splatwizard_core.api import RasterOptions, photometric_loss

if TYPE_CHECKING:
    from splatwizard_core.api import Rasterizer, SplatModel, View


@dataclass(frozen=True)
class Worth:
    """Losses of the pictures of some views by the removal of each splat alone.

    change          [N] float64: squared change of the pictures; 0: hidden, or unseen
    cost            [N] float64: how much the squared error rises at once; below 0: the pictures get better
    loss_of_error   rise of their mean photometric loss for a rise of the squared error by 1

    The others learn on: what is left of the slope of the error is theirs to take. So a splat is worth its change.
    """

    change: Tensor
    cost: Tensor
    loss_of_error: float

    @property
    def loss_rise(self) -> Tensor:
        """[N] float64: how much the loss rises by each removal."""
        return self.change * self.loss_of_error


@torch.no_grad()
def worth(
    model: SplatModel, views: Sequence[View], rasterizer: Rasterizer, background: Tensor, *, lambda_dssim: float
) -> Worth:
    """Return what each splat is worth to all `views`."""
    device = background.device
    found = removal_costs(lambda camera: model.gaussians(camera.to(device), rasterizer), views, rasterizer, background)
    scale = loss_of_error(model, views, rasterizer, background, lambda_dssim=lambda_dssim)
    return Worth(found.change, found.cost, scale)


@torch.no_grad()
def loss_of_error(
    model: SplatModel, views: Sequence[View], rasterizer: Rasterizer, background: Tensor, *, lambda_dssim: float
) -> float:
    """Return how much the mean photometric loss of `views` rises with their squared error, to first order.

    The loss goes with the root of the error.
    """
    device = background.device
    squared, total, options = 0.0, torch.zeros((), device=device), RasterOptions(background=background)
    for view in views:
        camera, truth = view.camera.to(device), view.image(background, device)
        image = rasterizer.render(model.gaussians(camera, rasterizer), camera, options).image
        squared += float((image - truth).double().square().sum())
        total += photometric_loss(image, truth, lambda_dssim=lambda_dssim).total
    return total.item() / len(views) / max(2 * squared, 1e-30)


def slopes(
    model: SplatModel,
    names: Iterable[str],
    views: Sequence[View],
    rasterizer: Rasterizer,
    background: Tensor,
    generator: torch.Generator,
) -> dict[str, Tensor]:
    """Return the sum over pixels and colours of (dI/dz)^2 for every number z of some parameters, by random signs."""
    device = background.device
    return sensitivities(
        lambda camera: model.gaussians(camera.to(device), rasterizer),
        {name: model.get_parameter(name) for name in names},
        [view.camera for view in views], rasterizer, generator, background,
    )  # fmt: skip
