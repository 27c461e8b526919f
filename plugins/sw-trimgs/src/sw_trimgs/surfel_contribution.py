"""The contribution of surfels, from what every rasterizer of surfels has: a picture and its gradient.

No rasterizer sums scores of surfels. But a picture is linear in the colours, so the derivative of its sum by the colour
of a surfel is the sum of alpha times transmittance over its pixels, exactly. How many pixels those are is taken from
the outline instead: the ellipse within which alpha is at least 1/255, and the disc of the low-pass filter where that is
larger. Unlike a count it includes pixels that are saturated before the surfel is reached.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from sw_gaussians.density.splitting import rotate

from splatwizard_core.api import GaussianInputs, RasterOptions

if TYPE_CHECKING:
    from torch import Tensor

    from splatwizard_core.api import Camera, GaussianModel, Rasterizer

ALPHA_MIN = 1 / 255
"""Least alpha that is blended."""
LOW_PASS = 0.5
"""Squared standard deviation of the low-pass filter of 2DGS, px^2."""


def blended(model: GaussianModel, camera: Camera, rasterizer: Rasterizer) -> Tensor:
    """[N] float32, the sum of alpha times transmittance over the pixels of one view. Needs a gradient of colours."""
    with torch.enable_grad():
        colors = model.means.new_zeros(model.num_rows, 3).requires_grad_()
        inputs = GaussianInputs(
            means=model.means.detach(),
            opacities=model.opacities.detach(),
            scales=model.scales.detach(),
            quats=model.quats.detach(),
            colors=colors,
        )
        image = rasterizer.render(inputs, camera, RasterOptions()).image
        if not image.requires_grad:  # nothing is in sight
            return torch.zeros_like(model.opacity_logits)
        (gradient,) = torch.autograd.grad(image[0].sum(), colors)
    return gradient[:, 0]


@torch.no_grad()
def footprint(model: GaussianModel, camera: Camera) -> Tensor:
    """[N] pixels of the image within the outline of each surfel; 0 behind the camera, and of what is too faint.

    The outline is that of the plane seen as by an affine camera at the centre; of one that reaches beyond the image
    the share of its bounding box that is inside counts.
    """
    center = model.means @ camera.R.T + camera.tau  # [N,3]
    z = center[:, 2]
    front = (z > camera.near) & (model.opacities > ALPHA_MIN)
    safe = torch.where(front, z, 1)
    squared = 2 * (model.opacities.clamp_min(ALPHA_MIN) / ALPHA_MIN).log()  # of the outline's radius, in sigmas
    focal = center.new_tensor([camera.fx, camera.fy])
    steps = []  # [N,2] px: how far the projection moves along each tangent in one standard deviation
    for axis in range(2):
        tangent = torch.zeros_like(center)
        tangent[:, axis] = model.scales[:, axis]
        moved = rotate(model.quats, tangent) @ camera.R.T
        steps.append(focal * (moved[:, :2] - center[:, :2] * (moved[:, 2:] / safe[:, None])) / safe[:, None])
    a, b = steps
    area = math.pi * squared * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).abs().clamp_min(LOW_PASS)
    half = (squared[:, None] * (a.square() + b.square()).clamp_min(LOW_PASS)).sqrt()  # [N,2] of the box
    middle = focal * center[:, :2] / safe[:, None] + center.new_tensor([camera.cx, camera.cy])
    size = center.new_tensor([camera.width, camera.height])
    inside = torch.minimum(middle + half, size).clamp_min(0) - torch.minimum((middle - half).clamp_min(0), size)
    share = (inside.clamp_min(0) / (2 * half)).prod(dim=1)
    return torch.where(front, area * share, 0)
