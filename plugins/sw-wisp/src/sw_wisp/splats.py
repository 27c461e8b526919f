"""From the 22 numbers of splats to what a rasterizer draws."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from sw_wisp.appearance import AppearanceNetwork, sh_dc_of
from sw_wisp.layers import Known
from sw_wisp.numbers import GROUPS
from sw_wisp.shape import covariance


class Draws(NamedTuple):
    """Random numbers of a step of N splats, where it needs them.

    sample      [S] int64 splats whose bits are counted
    noise       [N+S,22] in place of rounding, of all splats and of the sample
    places      [N,3] of U(0,1), within cells
    known       what packets that are drawn alone tell
    soft        see `Rounding`
    """

    sample: Tensor | None = None
    noise: Tensor | None = None
    places: Tensor | None = None
    known: Known | None = None
    soft: Tensor | None = None


class Shown(NamedTuple):
    """N splats as a rasterizer takes them, and what a step counts.

    opacities [N]; covariances [N,6], see `shape.covariance`; dc [N,1,3], SH band 0; rest [N,K,3], the bands above it
    means       [N,3]; None: those of the model
    bits        of a splat; None: they are not counted
    visible     [N] bool; None: all are
    """

    opacities: Tensor
    covariances: Tensor
    dc: Tensor
    rest: Tensor
    means: Tensor | None = None
    bits: Tensor | None = None
    visible: Tensor | None = None


def drawable(values: Tensor, log_edges: Tensor, bounds: tuple[float, float], network: AppearanceNetwork) -> Shown:
    """Return what is drawn of numbers [N,22]; differentiable in them and the network.

    log_edges   [N] logarithms of the edges of the splats' cells
    bounds      of the logarithms of the standard deviations
    """
    opacity, shape, size, colour, latents = (values[:, group.columns] for group in GROUPS)
    covariances = covariance(shape, size.squeeze(1) + log_edges, *bounds)
    return Shown(torch.sigmoid(opacity.squeeze(1)), covariances, sh_dc_of(colour), network(latents, colour))
