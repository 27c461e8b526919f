"""Requests rewritten so that a rasterizer without a feature can serve them: composition instead of new kernels."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import torch
from torch import Tensor

from splatwizard_core.errors import CapabilityError
from splatwizard_core.gaussians.inputs import SH, GaussianInputs
from splatwizard_core.rendering.info import RasterizerInfo
from splatwizard_core.rendering.rasterizer import AccumOutput, Rasterizer, RasterOptions, RenderResult
from splatwizard_core.scene.camera import Camera

_AS_FEATURES = frozenset({"DEPTH_INVERSE", "DEPTH_ACCUM", "DEPTH_EXPECTED", "ALPHA_MAP"})
_REWRITTEN = frozenset({"SPLIT_SH", "INDEXED_SH", "INDEXED_GEOM"})


def adapted_requirements(required: frozenset[str], missing: frozenset[str]) -> frozenset[str] | None:
    """The features that a rasterizer needs once `missing` is composed from others; None if some of it cannot be."""
    if not missing <= _AS_FEATURES | _REWRITTEN:
        return None
    return required - missing | ({"EXTRA_FEATURES"} if missing & _AS_FEATURES else frozenset())


class AdaptedRasterizer:
    """A rasterizer behind rewritten requests: every feature in `missing` is composed from others.

    SPLIT_SH      dc and rest are concatenated
    INDEXED_*     codebooks are gathered, scale factors multiplied in; autograd scatters
    DEPTH_*, ALPHA_MAP    z, 1/z and 1 are composited as extra features (no median)
    """

    def __init__(self, inner: Rasterizer, missing: frozenset[str]) -> None:
        self.inner = inner
        self.missing = missing
        self.info: RasterizerInfo = replace(inner.info, features=inner.info.features | missing)

    def render(self, g: GaussianInputs, cam: Camera, opt: RasterOptions) -> RenderResult:
        """Draw one view; `RenderResult.inputs` are the inputs as they were handed in.

        Raises CapabilityError for composed maps beside features that are detached from the geometry.
        """
        drawn = self._rewritten(g)
        if not self.missing & _AS_FEATURES or not (opt.depth or opt.alpha):
            return replace(self.inner.render(drawn, cam, opt), inputs=g)
        if opt.features_detach_geometry and g.features is not None:
            # The maps would be detached with the features: their gradient would be wrong without a word.
            composed = self.missing & _AS_FEATURES
            raise CapabilityError(
                f"rasterizer '{self.info.name}' composes {', '.join(sorted(composed))} from features and cannot detach "
                "others; render twice, or prefer one that offers them (`sw list-plugins`)",
                missing=composed,
            )
        maps = _map_channels(g, cam)
        extra = torch.stack(list(maps.values()), dim=1)  # [N,3]
        drawn.features = extra if g.features is None else torch.cat([g.features, extra], dim=1)
        # The median is no sum over splats: whoever serves this request offers it.
        passed_on = replace(opt, depth=opt.depth & {"median"}, alpha=False, features_detach_geometry=False)
        result = self.inner.render(drawn, cam, passed_on)
        assert result.features is not None
        own = result.features.shape[0] - len(maps)
        found = dict(zip(maps, torch.split(result.features[own:], 1), strict=True)) | result.depth
        found["expected"] = found["accumulated"] / found["alpha"].clamp(min=1e-10)
        return replace(
            result,
            inputs=g,
            features=result.features[:own] if g.features is not None else None,
            depth={name: found[name] for name in sorted(opt.depth)},
            alpha=found["alpha"] if opt.alpha else None,
        )

    def visible_filter(self, g: GaussianInputs, cam: Camera) -> Tensor:
        """Radii [N] int32 from geometry alone."""
        return self.inner.visible_filter(self._rewritten(g), cam)

    def accumulate(self, g: GaussianInputs, cams: Iterable[Camera], opt: RasterOptions) -> AccumOutput:
        """Sum scores over views; no map is kept, so none is asked for."""
        if self.missing & _AS_FEATURES:
            opt = replace(opt, depth=frozenset(), alpha=False)
        return self.inner.accumulate(self._rewritten(g), cams, opt)

    def _rewritten(self, g: GaussianInputs) -> GaussianInputs:
        """A shallow copy without the storage forms that the rasterizer does not read."""
        g = g.gathered(geometry="INDEXED_GEOM" in self.missing, colors="INDEXED_SH" in self.missing)
        if g.sh is not None and g.sh.dc is not None and "SPLIT_SH" in self.missing:
            g.sh = SH(dense=g.sh.to_dense(), active_degree=g.sh.active_degree)
        return g


def _map_channels(g: GaussianInputs, cam: Camera) -> dict[str, Tensor]:
    """One value per Gaussian whose weighted sum over a pixel is the map, [N] each."""
    cam = cam.to(g.means.device, g.means.dtype)
    z = g.means @ cam.R[2] + cam.tau[2]
    safe = torch.where(z > cam.near, z, 1)  # others are culled; 1/z must not turn their gradient into NaN
    return {"accumulated": safe, "inverse": 1 / safe, "alpha": torch.ones_like(z)}
