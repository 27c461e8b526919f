"""Inference-only CUDA rasterizers: faster than `standard`, approximate, no gradients.

They compute the exponent as in FlashGS (arXiv 2408.07967) and TC-GS (arXiv 2505.24796). Everything before the
pixels (projection, exact ellipse-tile tests, sorting) is the standard family's.
"""

from __future__ import annotations

import torch

from splatwizard_core.api import Camera, CapabilityError, ConfigError, GaussianInputs, RasterizerInfo, RasterOptions
from sw_rasterizers import plugin
from sw_rasterizers.call import Call, Flag
from sw_rasterizers.standard import StandardRasterizer


class InferenceRasterizer(StandardRasterizer):
    """Base of both. Images are [3,H,W], float32, or uint8 with `dtype_out="uint8"`: round(255 clamp(x, 0, 1)).

    A pixel draws the splat that brings its transmittance below 1e-4 (the standard rasterizers leave it out) and goes on
    until all 32 pixels of its warp are below. Alpha is still clamped at 0.99 and cut below 1/255.
    """

    method: Flag

    def _call(self, g: GaussianInputs, cam: Camera, opt: RasterOptions, *, learns: bool) -> Call:
        least = self.info.min_cc
        if least is not None and torch.cuda.get_device_capability(g.means.device) < least:
            raise CapabilityError(
                f"rasterizer '{self.info.name}' needs a GPU of compute capability {least[0]}.{least[1]} or higher",
                missing=frozenset(),
            )
        call = super()._call(g, cam, opt, learns=learns)
        call.flags |= self.method
        if opt.dtype_out == "uint8":
            call.flags |= Flag.BYTES
        return call


class FlashRasterizer(InferenceRasterizer):
    """FlashGS-style: base-2 exponent including the opacity, a polynomial around the tile centre."""

    info: RasterizerInfo = RasterizerInfo.declared(plugin.register_rasterizers, "flash")
    method = Flag.FLASH


class TensorCoreRasterizer(InferenceRasterizer):
    """TC-GS-style: exponents on tensor cores, each coefficient split into two float16, float32 accumulation.

    Raises ConfigError for a low-pass below 0.1 px^2: the exponents of sharper splats leave the range of a half.
    """

    info: RasterizerInfo = RasterizerInfo.declared(plugin.register_rasterizers, "tcgs")
    method = Flag.TENSOR_CORES

    def _call(self, g: GaussianInputs, cam: Camera, opt: RasterOptions, *, learns: bool) -> Call:
        if opt.eps2d < 0.1:
            raise ConfigError(f"rasterizer 'tcgs' needs eps2d of 0.1 or more, got {opt.eps2d}")
        return super()._call(g, cam, opt, learns=learns)
