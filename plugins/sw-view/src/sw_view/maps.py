"""Depth, normals and alpha of one view: asked for together with the picture, and brought into one form.

Source: 2D Gaussian Splatting (arXiv 2403.17888), section 5.1; the depth modes are those of `RasterOptions.depth`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from sw_gaussians.surface import depth_modes, depth_normals, surface_depth, world_normals
from torch import Tensor

from splatwizard_core.api import Camera, RasterOptions, RenderResult, UserInputError
from sw_view.modes import AUTO, DRAWN, RENDERED, SURFACE


@dataclass(frozen=True)
class MapRequest:
    """Maps that are wanted of each view.

    depths          of `modes.DEPTHS`
    normals         of `modes.NORMALS`, "auto" until `suited` decides, or None
    alpha           whether to keep the alpha map
    depth_ratio     r of the surface, 0..1
    """

    depths: tuple[str, ...] = ()
    normals: str | None = None
    alpha: bool = False
    depth_ratio: float = 0.0

    @property
    def is_empty(self) -> bool:
        """Whether nothing but the picture is wanted."""
        return not self.depths and self.normals is None and not self.alpha

    def suited(self, *, surfels: bool, what: str) -> MapRequest:
        """The request for `what`, a name for messages, which holds surfels or does not; "auto" is decided.

        Raises UserInputError for maps that only surfels have.
        """
        if self.normals == AUTO:
            return replace(self, normals=RENDERED if surfels else SURFACE).suited(surfels=surfels, what=what)
        if not surfels and self.normals == RENDERED:
            raise UserInputError(
                f"{what} holds no surfels, so it has no normals of its own: --normals surface takes them from the depth"
            )
        if not surfels and SURFACE in self.depths:
            raise UserInputError(
                f"{what} holds no surfels, so it has no depth of a surface: --depth takes {', '.join(DRAWN)}"
            )
        return self

    def options(self, base: RasterOptions) -> RasterOptions:
        """The options that draw these maps beside the picture; `base` itself if none is wanted."""
        if self.is_empty:
            return base
        modes = set(self.depths) - {SURFACE}
        if SURFACE in (*self.depths, self.normals):
            modes |= depth_modes(self.depth_ratio)
        return replace(base, depth=frozenset(modes), normals=self.normals == RENDERED, alpha=True)


@dataclass(frozen=True)
class Maps:
    """Maps of one view, all finite.

    depths      mode -> [H,W] in the units of the scene ("inverse": their reciprocal); 0: no surface
    normals     [3,H,W] in the world's frame, unit length or 0 | None
    alpha       [H,W] in 0..1
    camera      the view's
    """

    depths: Mapping[str, Tensor]
    normals: Tensor | None
    alpha: Tensor
    camera: Camera


def maps_of(result: RenderResult, camera: Camera, request: MapRequest) -> Maps:
    """Bring what was drawn with `request.options(...)` into one form, on the device of the result."""
    assert result.alpha is not None
    depths = {mode: _finite(result.depth[mode][0]) for mode in request.depths if mode != SURFACE}
    normals, surface = None, None
    if SURFACE in (*request.depths, request.normals):
        surface = surface_depth(result.depth, request.depth_ratio)
    if SURFACE in request.depths:
        assert surface is not None
        depths[SURFACE] = surface[0]
    if request.normals == SURFACE:
        assert surface is not None
        normals = depth_normals(surface, camera) * _surrounded(surface)
    elif request.normals == RENDERED:
        assert result.normals is not None
        normals = torch.nn.functional.normalize(world_normals(_finite(result.normals), camera), dim=0)
    # In the order in which they were asked for.
    ordered = {mode: depths[mode] for mode in request.depths}
    return Maps(ordered, normals, _finite(result.alpha[0]).clamp(0, 1), camera)


def _finite(values: Tensor) -> Tensor:
    return torch.nan_to_num(values, nan=0.0, posinf=0.0, neginf=0.0)


def _surrounded(depth: Tensor) -> Tensor:
    """[1,H,W] bool: pixels with a surface whose four neighbours have one too; elsewhere differences mean nothing."""
    there = depth > 0
    inside = torch.zeros_like(there)
    inside[:, 1:-1, 1:-1] = (
        there[:, 1:-1, 1:-1] & there[:, :-2, 1:-1] & there[:, 2:, 1:-1] & there[:, 1:-1, :-2] & there[:, 1:-1, 2:]
    )
    return inside
