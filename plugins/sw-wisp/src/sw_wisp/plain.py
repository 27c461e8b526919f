"""Splats as plain Gaussians: what a decoder returns, and any rasterizer draws without a network."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from splatwizard_core.api import GaussianModel
from sw_wisp.appearance import AppearanceNetwork, sh_dc_of
from sw_wisp.cube import Cube
from sw_wisp.decoded import Decoded
from sw_wisp.numbers import GROUPS
from sw_wisp.shape import scales_and_quats

THINNEST = 1e-6
"""Smallest standard deviation, in edges of the root cube; the largest is the edge itself."""


def bounds_in(cube: Cube) -> tuple[float, float]:
    """Return the bounds of the log scales of splats in a root cube."""
    return math.log(THINNEST * cube.edge), math.log(cube.edge)


@torch.no_grad()
def plain_gaussians(
    means: Tensor, values: Tensor, log_edges: Tensor, cube: Cube, network: AppearanceNetwork
) -> GaussianModel:
    """Return splats as Gaussians that need no network to be drawn.

    means       [N,3] world units
    values      [N,22] their numbers
    log_edges   [N] logarithms of the edges of their cells
    """
    opacity, shape, size, colour, latents = (values[:, group.columns] for group in GROUPS)
    log_scales, quats = scales_and_quats(shape, size.squeeze(1) + log_edges)
    log_scales, rest = log_scales.clamp(*bounds_in(cube)), network(latents, colour)
    return GaussianModel.from_tensors(means, sh_dc_of(colour), rest, opacity.squeeze(1), log_scales, quats)


def gaussians_of(decoded: Decoded) -> GaussianModel:
    """Return the splats of a file, or of a prefix of it. Raises ValueError for an appearance network that is none."""
    log_edges = math.log(decoded.cube.edge) - math.log(2.0) * torch.from_numpy(decoded.state.levels)
    network = AppearanceNetwork.of_layers(decoded.appearance, decoded.sh_degree)
    return plain_gaussians(decoded.means(), decoded.values(), log_edges.float(), decoded.cube, network)
