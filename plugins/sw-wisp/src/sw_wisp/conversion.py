"""From a trained 3DGS scene to splats of wisp."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from sw_gaussians.density.mcmc import cap_for, pixels_of
from torch import Tensor

from splatwizard_core.api import GaussianModel
from sw_wisp.appearance import AppearanceNetwork, colour_of
from sw_wisp.cube import Cube
from sw_wisp.model import WispModel
from sw_wisp.numbers import LATENTS
from sw_wisp.positions import MARGIN, middle_scales
from sw_wisp.rate_model import PyramidRate, StaticRate
from sw_wisp.shape import log_covariance
from sw_wisp.worth import Worth, slopes, worth

if TYPE_CHECKING:
    from splatwizard_core.api import Rasterizer, View
    from sw_wisp.config import WispConfig

HEAD_ROOM = 1.5  # splats that may begin, in caps: removal takes the rest while it trains
FAR_SHARE = 1e-4
"""Of the worth of all splats: what may lie beyond the root cube, and goes. MCMC throws some splats a thousand rooms
away, where nobody sees them, and cells are a 2^18th of the cube at the finest."""
WIDEST_RATIO = 9.7
"""Largest difference of log scales that begins: the deviator's coordinates stay within their limit. A thinner splat
looks the same."""


def kept_rows(worth: Worth, views: Sequence[View], config: WispConfig) -> Tensor:
    """Return the rows [M] int64, ascending, that begin: the worthiest that the cap lets, less a number that do harm."""
    n = len(worth.change)
    most = config.budget.cap or min(cap_for(views), config.budget.density * pixels_of(views))
    cap = round(HEAD_ROOM * most * config.budget.cap_factor)
    needless = min(int((worth.cost <= 0).sum()), int(config.budget.worthless * n))
    keep = max(1, min(n - needless, cap))
    return torch.sort(worth.change, descending=True, stable=True).indices[:keep].sort().values


def within_reach(means: Tensor, worth: Tensor) -> Tensor:
    """Tell [N] which splats lie within twice the distance from their middle that holds all but FAR_SHARE of the worth.

    means   [N,3]
    worth   [N] >= 0
    """
    away = (means - means.median(dim=0).values).abs().amax(dim=1)
    order = torch.sort(away, stable=True).indices
    summed = worth.double()[order].cumsum(0)
    reach = int(torch.searchsorted(summed, (1 - FAR_SHARE) * summed[-1:]))
    return away <= 2 * away[order[min(reach, len(order) - 1)]]


def converted(
    model: GaussianModel,
    views: Sequence[View],
    rasterizer: Rasterizer,
    background: Tensor,
    config: WispConfig,
    generator: torch.Generator,
) -> WispModel:
    """Return the splats of a trained scene, at levels by their size.

    generator   of random signs and of the network's first weights, on the CPU
    """
    model.active_sh_degree = model.max_sh_degree
    found = worth(model, views, rasterizer, background, lambda_dssim=config.loss.lambda_dssim)
    rows = kept_rows(found, views, config)
    rows = rows[within_reach(model.means.detach()[rows], found.change[rows])]
    network = AppearanceNetwork(
        LATENTS.width, config.appearance.hidden, max(model.max_sh_degree, 1), generator=generator
    ).to(background.device)
    with torch.no_grad():
        if model.max_sh_degree:
            weights = slopes(model, ["sh_rest"], views, rasterizer, background, generator)["sh_rest"].flatten(1).mean(1)
            latents = network.fit(model.sh_rest[rows], weights[rows])
        else:
            latents = model.means.new_zeros(len(rows), LATENTS.width)
        logs = model.log_scales[rows].double()
        shape, size = log_covariance(
            torch.maximum(logs, logs.amax(dim=1, keepdim=True) - WIDEST_RATIO), model.quats[rows].double()
        )
        means = model.means[rows].detach()
        cube = Cube.around(means, margin=MARGIN)
        steps = torch.tensor(config.base_steps)
        rate: StaticRate | PyramidRate = StaticRate(steps)
        if config.context.kind == "pyramid":
            settings = {"adaptive": config.steps.adaptive, "size": config.context.networks}
            rate = PyramidRate(steps, **settings, generator=generator)
        return WispModel(
            means, model.opacity_logits[rows], shape, size, colour_of(model.sh_dc)[rows], latents,
            cube.levels(middle_scales(shape, size), config.positions.eta), cube=cube,
            network=network, rate=rate.to(background.device), sharpest=config.phases.sharpness,
        )  # fmt: skip
