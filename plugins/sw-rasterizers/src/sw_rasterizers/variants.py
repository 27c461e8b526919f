"""Variant of the standard rasterizer that reads colours and shapes from codebooks."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from splatwizard_core.api import Camera, GaussianInputs, RasterizerInfo, RasterOptions, RenderResult
from sw_rasterizers import plugin
from sw_rasterizers.segments import Tables
from sw_rasterizers.shared_colors import shared_colors
from sw_rasterizers.standard import StandardRasterizer


class IndexedRasterizer(StandardRasterizer):
    """Renders Gaussians with indexed SH colours and shapes, and a scale factor per Gaussian.

    The projection reads scales and quaternions through the index, forward and backward, and `shared_colors` the SH
    coefficients; only the resulting colour is stored per Gaussian. Gradients of codebook rows are summed in a fixed
    order on the CPU, for any number of threads. On CUDA those of shapes use atomics, unless torch uses deterministic
    algorithms; then shapes are gathered. Source: C3DGS (arXiv 2401.02436).
    """

    info = RasterizerInfo.declared(plugin.register_rasterizers, "c3dgs")

    def __init__(self, *, count: bool = False) -> None:
        super().__init__(count=count)
        self._tables = Tables()

    def render(self, g: GaussianInputs, cam: Camera, opt: RasterOptions) -> RenderResult:
        """Render as `standard`; `RenderResult.inputs` are the given inputs. Raises ShapeError for an invalid index."""
        self.info.check_request(g, opt)
        self._check_shapes(g)
        # Sums over the users of a shape are atomic on CUDA; torch's, of gathered rows, have an order where it is asked.
        gathers = g.means.is_cuda and torch.are_deterministic_algorithms_enabled()
        drawn = g.gathered(colors=False) if gathers else replace(g)
        if g.sh is not None and g.sh.codebook is not None and g.sh.indices is not None:
            segments = self._tables.segments(g.sh.indices, len(g.sh.codebook))
            center = cam.center.to(g.means)
            drawn.colors = shared_colors(g.sh, segments, g.means, center, clamp=opt.clamp_color)
            drawn.sh = None
        return replace(super().render(drawn, cam, opt), inputs=g)

    @torch.no_grad()
    def visible_filter(self, g: GaussianInputs, cam: Camera) -> Tensor:
        """Return radii [N] int32, px, from geometry alone; 0 = culled."""
        self.info.check_geometry(g)
        self._check_shapes(g)
        return super().visible_filter(g, cam)

    def _check_shapes(self, g: GaussianInputs) -> None:
        """Raise ShapeError for a shape index out of range; the kernels do not check."""
        if g.geom_indices is not None and g.scales is not None:
            self._tables.segments(g.geom_indices, len(g.scales))
