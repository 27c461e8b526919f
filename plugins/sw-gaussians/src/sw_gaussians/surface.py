"""Depth and normals of a surface from rendered depth maps, and rendered normals in world space.

Functions on the maps of a `RenderResult`, for training losses and for mesh extraction.
Source: 2D Gaussian Splatting (arXiv 2403.17888), section 5.1 and supplementary material.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from splatwizard_core.api import Camera, ConfigError


def depth_modes(depth_ratio: float) -> frozenset[str]:
    """Return the modes of `RasterOptions.depth` that `surface_depth` blends with a ratio, 0..1: those with a weight."""
    return frozenset(mode for mode, weight in (("expected", 1 - depth_ratio), ("median", depth_ratio)) if weight > 0)


def surface_depth(depth: Mapping[str, Tensor], depth_ratio: float) -> Tensor:
    """Return the depth of the surface, [1,H,W] camera z in world units: (1 - r) expected + r median.

    depth           the modes "expected" and "median" of `RenderResult.depth`, each [1,H,W]; a mode with weight 0 may
                    be left out
    depth_ratio     r in 0..1: 1 for bounded scenes, whose surface is the first that is half opaque; 0 for unbounded

    0 where nothing was hit; values that are not finite are 0. Differentiable in both maps.
    Raises ConfigError if a mode that is needed was not drawn, or if r is outside 0..1.
    """
    if not 0 <= depth_ratio <= 1:
        raise ConfigError(f"depth_ratio is {depth_ratio}; it must be between 0 (expected depth) and 1 (median depth)")
    found = None
    for mode, weight in (("expected", 1 - depth_ratio), ("median", depth_ratio)):
        if weight == 0:
            continue
        if mode not in depth:
            raise ConfigError(
                f"a depth_ratio of {depth_ratio} needs the {mode} depth, which was not drawn: "
                f"ask for it with RasterOptions(depth={{'{mode}'}})"
            )
        part = torch.nan_to_num(depth[mode], nan=0.0, posinf=0.0, neginf=0.0)
        part = part if weight == 1 else weight * part
        found = part if found is None else found + part
    assert found is not None  # the weights add up to 1
    return found


def depth_normals(depth: Tensor, camera: Camera) -> Tensor:
    """Return the normals of the surface that a depth map describes, [3,H,W] in the world frame, towards the camera.

    depth   [1,H,W] camera z, world units; 0 = no surface

    Those of `camera_normals`, turned.
    """
    return world_normals(camera_normals(depth, camera), camera)


def camera_normals(depth: Tensor, camera: Camera) -> Tensor:
    """Return the normals of the surface that a depth map describes, [3,H,W] in the camera's frame, towards it.

    The normal of a pixel is the cross product of the differences of its neighbours' points, below minus above and
    right minus left; points are those of pixel centres (the published code takes corners, which tilts a plane
    of tilt t by 0.5 / f sin^2 t).

    depth   [1,H,W] camera z, world units; 0 = no surface

    Unit length, or 0: on the border of one pixel, and where the points do not span a plane. Beside a pixel without
    surface the camera centre takes the place of the neighbour, as published. Differentiable in `depth`.
    """
    _, height, width = depth.shape
    normals = depth.new_zeros(3, height, width)
    if height < 3 or width < 3:
        return normals
    x = (torch.arange(1, width - 1, dtype=depth.dtype, device=depth.device) + 0.5 - camera.cx) / camera.fx
    y = (torch.arange(1, height - 1, dtype=depth.dtype, device=depth.device) + 0.5 - camera.cy) / camera.fy
    above, below, left, right = depth[0, :-2, 1:-1], depth[0, 2:, 1:-1], depth[0, 1:-1, :-2], depth[0, 1:-1, 2:]
    # With a = z_below - z_above, p = (z_below + z_above) / fy, b = z_right - z_left, q = (z_right + z_left) / fx
    #   down  = (a x, a y + p, a),  across = (b x + q, b y, b),
    #   down x across = (b p, a q, -(p q + a q y + b p x)):
    # no product of coordinates is ever subtracted from another, which would cost float32 half its digits.
    a, p = below - above, (below + above) / camera.fy  # [H-2,W-2]
    b, q = right - left, (right + left) / camera.fx
    bp, aq = b * p, a * q
    crossed = torch.stack([bp, aq, -(p * q + aq * y[:, None] + bp * x)])
    squared = (crossed * crossed).sum(dim=0, keepdim=True)
    # No division by an epsilon: where nothing was hit its gradient would be huge.
    flat = squared > 0
    unit = torch.where(flat, crossed * torch.rsqrt(torch.where(flat, squared, 1.0)), 0.0)
    normals[:, 1:-1, 1:-1] = unit
    return normals


def world_normals(normals: Tensor, camera: Camera) -> Tensor:
    """Return the normals [3,H,W] of `RenderResult.normals` turned from the camera's frame to the world's.

    Sums of weighted unit normals stay such sums: nothing is normalised. Differentiable.
    """
    rotation = camera.R.to(normals)
    turned: Tensor = (rotation.T @ normals.flatten(1)).reshape(normals.shape)
    return turned
