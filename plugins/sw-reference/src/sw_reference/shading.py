"""The colour of each drawn splat, and of what is behind all of them."""

from __future__ import annotations

from torch import Tensor

from splatwizard_core.api import Camera, GaussianInputs, RasterOptions
from sw_reference.spherical_harmonics import sh_colors


def splat_colors(g: GaussianInputs, rows: Tensor, cam: Camera, opt: RasterOptions) -> Tensor:
    """[V,C]: precomputed colours as they are, or spherical harmonics seen from the camera."""
    if g.colors is not None:
        return g.colors[rows]
    assert g.sh is not None
    return sh_colors(g.sh, cam.center, g.means, rows=rows, clamp=opt.clamp_color)


def background_image(opt: RasterOptions, channels: int, cam: Camera, like: Tensor) -> Tensor:
    """[C,H,W]."""
    background = opt.background_of(channels, cam, like)
    if background is None:
        return like.new_zeros(channels, cam.height, cam.width)
    if background.ndim == 1:
        return background[:, None, None].expand(channels, cam.height, cam.width)
    return background
