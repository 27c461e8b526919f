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
    """Exact costs of the removal of each splat alone, over some views.

    squared_error   [N] float64: how much the squared error rises; below 0: the pictures get better
    total_error     squared error of the views as they are
    loss            their mean photometric loss
    """

    squared_error: Tensor
    total_error: float
    loss: float

    @property
    def loss_of_error(self) -> float:
        """Rise of the loss for a rise of the squared error by 1, to first order: it goes with the error's root."""
        return self.loss / max(2 * self.total_error, 1e-30)

    @property
    def loss_rise(self) -> Tensor:
        """[N] float64: how much the loss rises by each removal."""
        return self.squared_error * self.loss_of_error


@torch.no_grad()
def worth(
    model: SplatModel, views: Sequence[View], rasterizer: Rasterizer, background: Tensor, *, lambda_dssim: float
) -> Worth:
    """Return what each splat is worth to all `views`."""
    device = background.device
    costs = removal_costs(lambda camera: model.gaussians(camera.to(device), rasterizer), views, rasterizer, background)
    total, options = torch.zeros((), device=device), RasterOptions(background=background)
    for view in views:
        camera = view.camera.to(device)
        image = rasterizer.render(model.gaussians(camera, rasterizer), camera, options).image
        total += photometric_loss(image, view.image(background, device), lambda_dssim=lambda_dssim).total
    return Worth(costs.cost, costs.squared_error, total.item() / len(views))


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
