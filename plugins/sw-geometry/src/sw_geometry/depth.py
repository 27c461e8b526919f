"""Depth and colour of a model from the cameras of a scene: what is fused into a mesh."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from sw_gaussians.surface import depth_modes, surface_depth
from torch import Tensor

from splatwizard_core.api import GaussianInputs, Rasterizer, RasterOptions, SplatModel, View
from sw_geometry.mesh import Floats


@dataclass(frozen=True, eq=False)
class DepthView:
    """One view as it is fused.

    depth   [H,W] float32 camera z, units of the scene; 0 = no surface
    color   [H,W,3] float32 in 0..1
    K, E    [3,3] intrinsics and [4,4] world to camera, float64
    """

    name: str
    depth: NDArray[np.float32]
    color: NDArray[np.float32]
    K: Floats
    E: Floats


def diffuse(inputs: GaussianInputs) -> GaussianInputs:
    """The Gaussians with the colour that does not depend on the view: spherical harmonics of degree 0."""
    return inputs if inputs.sh is None else replace(inputs, sh=replace(inputs.sh, active_degree=0))


def depth_of(
    model: SplatModel, view: View, rasterizer: Rasterizer, options: RasterOptions, *, depth_ratio: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Depth [1,H,W] of the surface (0 where nothing is hit), alpha [1,H,W] and diffuse colour [3,H,W] of a view.

    Raises CapabilityError if no rasterizer offers the depth.
    """
    camera = view.camera.to(model.device)
    asked = replace(options, depth=depth_modes(depth_ratio), alpha=True, background=None)
    with torch.no_grad():
        result = rasterizer.render(diffuse(model.gaussians(camera, rasterizer)), camera, asked)
    assert result.alpha is not None
    return surface_depth(result.depth, depth_ratio), result.alpha, result.image


def depth_views(
    model: SplatModel,
    views: Sequence[View],
    rasterizer: Rasterizer,
    options: RasterOptions,
    *,
    depth_ratio: float,
    alpha_min: float,
    mask: bool,
) -> Iterator[DepthView]:
    """Depth and colour of every view, drawn one at a time.

    alpha_min   less opaque pixels show no surface
    mask        neither do pixels outside the mask of a view that has one
    """
    for view in views:
        depth, alpha, image = depth_of(model, view, rasterizer, options, depth_ratio=depth_ratio)
        depth = torch.where(alpha >= alpha_min, depth, 0.0)
        if mask and view.mask is not None:
            depth = torch.where(view.mask.to(depth.device), depth, 0.0)
        # What is not fully opaque has a colour darkened by the black behind it.
        color = (image / alpha.clamp(min=1e-3)).clamp(0, 1).permute(1, 2, 0)
        yield as_depth_view(view, depth[0], color)


def as_depth_view(view: View, depth: Tensor, color: Tensor) -> DepthView:
    """A view of depth [H,W] and colour [H,W,3], moved to the host."""
    camera = view.camera
    return DepthView(
        view.name,
        depth.float().cpu().numpy(),
        color.float().cpu().numpy(),
        camera.K.double().cpu().numpy(),
        camera.viewmat.double().cpu().numpy(),
    )
