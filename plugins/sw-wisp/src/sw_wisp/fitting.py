"""Networks of the context fitted to a scene as it is: fewest bits for given numbers at given steps, no pictures."""

from __future__ import annotations

import torch
from torch import Tensor

from sw_wisp.context import ContextNetworks
from sw_wisp.pyramid import walked_features
from sw_wisp.rate import bits, sigma_of
from sw_wisp.rounding import HARD, Rounding

ROUNDS = 4
"""How often indices and features are brought up to date with what the networks say."""
LAST_ROUND_LR = 0.05
"""Step size of the last update, times that of the first."""


def fitted_context(
    levels: Tensor,
    cells: Tensor,
    values: Tensor,
    base_steps: Tensor,
    *,
    updates: int = 800,
    batch: int = 2048,
    lr: float = 0.01,
    seed: int = 0,
) -> ContextNetworks:
    """Networks that code values in few bits with base steps, one subset of splats and no refinements.

    levels      [N] int64, and cells [N,3] at those levels
    values      [N,22] in their own units
    base_steps  [22]
    updates     Adam steps on `batch` splats each
    """
    generator = torch.Generator().manual_seed(seed)
    net = ContextNetworks(base_steps, adaptive=False, generator=generator).to(values.device)
    values, steps = values.detach().float(), base_steps.to(values.device).float()
    net.measure_prior(values / steps)
    indices = (values / steps - net.prior / 4096).round()
    features = walked_features(net.prior, levels, cells, values / steps, indices)
    net.start(*features, values / steps)
    optimizer = torch.optim.Adam(net.parameters(), lr=lr)
    for step in range(updates):
        if step and step % max(updates // ROUNDS, 1) == 0:
            features = _renewed(net, features, levels, cells, values)
            net.rounds = step >= updates // 2
        optimizer.param_groups[0]["lr"] = lr * LAST_ROUND_LR ** (step / updates)
        rows = torch.randint(len(values), (min(batch, len(values)),), generator=generator).to(values.device)
        forecast, drawn = net(features[0][rows], features[1][rows], values[rows], Rounding(HARD))
        cost = bits(drawn - forecast.mean, sigma_of(forecast.scale, forecast.steps), forecast.steps).sum(1).mean()
        optimizer.zero_grad()
        cost.backward()
        optimizer.step()
    return net


@torch.no_grad()
def _renewed(
    net: ContextNetworks, features: tuple[Tensor, Tensor], levels: Tensor, cells: Tensor, values: Tensor
) -> tuple[Tensor, Tensor]:
    forecast, drawn = net(*features, values, Rounding(HARD))
    indices = ((drawn - forecast.mean) / forecast.steps).round()
    return walked_features(net.prior, levels, cells, drawn / net.base_steps, indices)
