"""From the 22 numbers of splats to what a rasterizer draws."""

from __future__ import annotations

import torch
from torch import Tensor

from sw_wisp.appearance import AppearanceNetwork, sh_dc_of
from sw_wisp.numbers import GROUPS
from sw_wisp.shape import covariance

Drawable = tuple[Tensor, Tensor, Tensor, Tensor]
"""Opacities [N]; covariances [N,6], see `shape.covariance`; SH band 0 [N,1,3]; the bands above it [N,K,3]."""


def drawable(values: Tensor, log_edges: Tensor, bounds: tuple[float, float], network: AppearanceNetwork) -> Drawable:
    """Return what is drawn of numbers [N,22]; differentiable in them and the network.

    log_edges   [N] logarithms of the edges of the splats' cells
    bounds      of the logarithms of the standard deviations
    """
    opacity, shape, size, colour, latents = (values[:, group.columns] for group in GROUPS)
    covariances = covariance(shape, size.squeeze(1) + log_edges, *bounds)
    return torch.sigmoid(opacity.squeeze(1)), covariances, sh_dc_of(colour), network(latents, colour)
