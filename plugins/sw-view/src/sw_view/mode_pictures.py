"""Pictures of a model by mode: its colours, depth along Turbo, or normals."""

from __future__ import annotations

import torch

from splatwizard_core.api import Camera
from sw_view.colors import depth_colors, normal_colors
from sw_view.drawing import Drawing
from sw_view.frames import Pixels
from sw_view.maps import MapRequest, maps_of
from sw_view.modes import AUTO

PICTURE, DEPTH, NORMALS = "picture", "depth", "normals"
MODES = (PICTURE, DEPTH, NORMALS)


def mode_picture(drawing: Drawing, camera: Camera, mode: str = PICTURE) -> Pixels:
    """Draw what a camera sees, [H,W,3]. Raises CapabilityError where no rasterizer offers the mode.

    mode    of `MODES`; depths are coloured between the 2nd and the 98th percentile of the view
    """
    if mode == PICTURE:
        return pixels_of(drawing.render(camera).image)
    if mode == DEPTH:
        request = MapRequest(("expected",))
    else:
        request = MapRequest(normals=AUTO, depth_ratio=drawing.depth_ratio)
        request = request.suited(surfels=drawing.has_surfels(camera), what="the model")
    result = drawing.render(camera, request.options(drawing.options))
    maps = maps_of(result, camera.to(drawing.device), request)
    alpha = maps.alpha.cpu().numpy()
    if mode == DEPTH:
        return depth_colors(maps.depths["expected"].cpu().numpy(), alpha)
    assert maps.normals is not None
    return normal_colors(maps.normals.cpu().numpy(), camera.R.cpu().numpy(), alpha)


def pixels_of(image: torch.Tensor) -> Pixels:
    """Return a rendered image [3,H,W] as [H,W,3] of 8 bit, on the host."""
    rounded = (image.clamp(0, 1) * 255).round_().to(torch.uint8)
    pixels: Pixels = rounded.permute(1, 2, 0).contiguous().cpu().numpy()
    return pixels
