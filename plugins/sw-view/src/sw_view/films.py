"""Videos of a trajectory: the picture, and one for each map, in the same colours from the first frame to the last."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from splatwizard_core.api import track
from sw_view.colors import depth_colors, depth_range, normal_colors
from sw_view.maps import MapRequest, Maps, maps_of
from sw_view.video import video_file

if TYPE_CHECKING:
    from splatwizard_core.api import Camera
    from sw_view.drawing import Drawing
    from sw_view.trajectory import Trajectory

PROBES = 8
"""Frames that are drawn beforehand to find the depths that the colours of a video span."""


def draw_films(drawing: Drawing, trajectory: Trajectory, path: Path, request: MapRequest) -> list[Path]:
    """Draw a trajectory into the video `path`, its maps into NAME_depth_MODE, NAME_normals, NAME_alpha beside it.

    Returns the files. Each is complete or absent, all or none. Depths go along Turbo between the least 2nd and the
    largest 98th percentile of a few frames. Raises CapabilityError, before anything is drawn, where no rasterizer
    offers the maps.
    """
    first = trajectory.cameras[0]
    options = request.options(drawing.options)

    def shown(camera: Camera) -> tuple[torch.Tensor, Maps | None]:
        result = drawing.render(camera, options)
        return result.image, None if request.is_empty else maps_of(result, camera.to(drawing.device), request)

    ranges: dict[str, tuple[float, float]] = {}
    if request.depths:
        chosen = _spread(trajectory.cameras)
        with track("depths", total=len(chosen), unit="views") as bar:
            for camera in chosen:
                _, maps = shown(camera)
                assert maps is not None
                for mode, found in _ranges(maps).items():
                    low, high = ranges.get(mode, found)
                    ranges[mode] = min(low, found[0]), max(high, found[1])
                bar.advance()
    kinds = [*(f"depth_{mode}" for mode in request.depths), *(["normals"] if request.normals else []),
             *(["alpha"] if request.alpha else [])]  # fmt: skip
    paths = {"": path, **{kind: path.with_name(f"{path.stem}_{kind}{path.suffix}") for kind in kinds}}
    with ExitStack() as stack, track("render", total=len(trajectory.cameras), unit="frames", foretells=True) as bar:
        size = first.width, first.height
        videos = {kind: stack.enter_context(video_file(each, size, trajectory.fps)) for kind, each in paths.items()}
        for camera in trajectory.cameras:
            image, maps = shown(camera)
            videos[""].add(_bytes(image.clamp(0, 1).permute(1, 2, 0)))
            for kind, colors in ({} if maps is None else _colors(maps, ranges, request)).items():
                videos[kind].add(colors)
            bar.advance()
    return list(paths.values())


def _spread(cameras: Sequence[Camera]) -> list[Camera]:
    """At most PROBES of the cameras, evenly."""
    return [cameras[i] for i in np.linspace(0, len(cameras) - 1, min(PROBES, len(cameras))).round().astype(int)]


def _ranges(maps: Maps) -> dict[str, tuple[float, float]]:
    alpha = maps.alpha.cpu().numpy()
    found = {mode: depth_range(depth.cpu().numpy(), alpha) for mode, depth in maps.depths.items()}
    return {mode: span for mode, span in found.items() if span is not None}


def _colors(maps: Maps, ranges: dict[str, tuple[float, float]], request: MapRequest) -> dict[str, NDArray[np.uint8]]:
    """The frame of each map's video, [H,W,3]."""
    alpha = maps.alpha.cpu().numpy()
    found = {
        f"depth_{mode}": depth_colors(depth.cpu().numpy(), alpha, ranges.get(mode))
        for mode, depth in maps.depths.items()
    }
    if maps.normals is not None:
        found["normals"] = normal_colors(maps.normals.cpu().numpy(), maps.camera.R.cpu().numpy(), alpha)
    if request.alpha:
        found["alpha"] = np.repeat(_bytes(maps.alpha)[..., None], 3, axis=2)
    return found


def _bytes(values: torch.Tensor) -> NDArray[np.uint8]:
    found: NDArray[np.uint8] = (values.detach() * 255).round().byte().cpu().numpy()
    return found
