"""The standard 3DGS rasterizer on compiled kernels."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from splatwizard_core.errors import CapabilityError, ConfigError, ShapeError
from splatwizard_core.gaussians.inputs import GaussianInputs
from splatwizard_core.plugins.registry import Registry
from splatwizard_core.rendering.negotiation import info_from_entry
from splatwizard_core.rendering.rasterizer import (
    AccumOutput,
    GradBuffer,
    RasterizerInfo,
    RasterOptions,
    RasterStats,
    RenderResult,
    check_offered,
    option_features,
    required_features,
)
from splatwizard_core.scene.camera import Camera
from sw_rasterizers import plugin
from sw_rasterizers.ops import Call, Flag, camera_numbers, rasterize, visible_radii

PROFILES = ("3dgs", "dgr-exact")


def _declared() -> RasterizerInfo:
    registry = Registry("rasterizer")
    plugin.register_rasterizers(registry)
    return info_from_entry(registry.entry("standard"))


class StandardRasterizer:
    """Standard 3DGS with complete gradients; float32, and float64 for checking.

    Profile "3dgs" draws the exact support of every splat, alpha >= 1/255 wherever it reaches, as the reference does.
    Profile "dgr-exact" also cuts each splat at the original's square of 16x16 tiles (3 sigma) and takes over the
    original's gradients through the clamps of alpha and of the Jacobian.

    count   also count evaluated and blended pixel-splat pairs into the statistics; slow, for benchmarks
    """

    info: RasterizerInfo = _declared()

    def __init__(self, *, count: bool = False) -> None:
        self.count = count

    def render(self, g: GaussianInputs, cam: Camera, opt: RasterOptions) -> RenderResult:
        """Draw one view; see the protocol. Raises CapabilityError, ConfigError or ShapeError."""
        self._check(g, opt)
        call = self._call(g, cam, opt)
        sh = g.sh
        image, radii, alpha, median = rasterize(
            call,
            {
                "means": g.means,
                "opacities": g.opacities,
                "scales": g.scales,
                "quats": g.quats,
                "cov3d": g.cov3d,
                "sh": None if sh is None else sh.dense,
                "sh_dc": None if sh is None else sh.dc,
                "sh_rest": None if sh is None else sh.rest,
                "colors": g.colors,
                "features": g.features,
            },
        )
        colors = 3 if g.colors is None else g.colors.shape[1]
        at = colors
        depth = {}
        if Flag.INVERSE_DEPTH in call.flags:
            depth["inverse"] = image[at : at + 1]
            at += 1
        if Flag.ACCUMULATED_DEPTH in call.flags:
            depth["accumulated"] = image[at : at + 1]
            at += 1
        if "expected" in opt.depth:
            depth["expected"] = depth["accumulated"] / alpha.clamp(min=1e-10)
        if "median" in opt.depth:
            depth["median"] = median
        visible, pairs, evaluated, blended, invalid = call.counts
        return RenderResult(
            image=image[:colors] if image.shape[0] > colors else image,
            radii=radii,
            inputs=g,
            alpha=alpha if opt.alpha else None,
            depth={name: depth[name] for name in sorted(opt.depth)},
            features=None if g.features is None else image[at:],
            grad2d=call.grad2d,
            absgrad2d=call.absgrad2d,
            stats=RasterStats(
                n_visible=visible,
                n_pairs=pairs,
                n_evaluated=evaluated if evaluated >= 0 else None,
                n_blended=blended if blended >= 0 else None,
                n_pixels=cam.width * cam.height,
                n_invalid=invalid,
                stage_seconds=call.seconds,
            ),
        )

    @torch.no_grad()
    def visible_filter(self, g: GaussianInputs, cam: Camera) -> Tensor:
        """Radii [N] int32 from means and covariances (opacities and colours are not looked at); 0 = culled."""
        g.validate()
        if g.geom_indices is not None or g.scale_factors is not None:
            raise CapabilityError(
                f"rasterizer '{self.info.name}' does not offer INDEXED_GEOM; `sw list-plugins` shows which one does",
                missing={"INDEXED_GEOM"},
            )
        self._check_device(g)
        return visible_radii(g.means, g.scales, g.quats, g.cov3d, _as_bytes(g.visible), cam)

    @torch.no_grad()
    def accumulate(self, g: GaussianInputs, cams: Iterable[Camera], opt: RasterOptions) -> AccumOutput:
        """No score is declared: raises CapabilityError for any that is asked for."""
        check_offered(self.info, option_features(opt))
        return AccumOutput({})

    def _check(self, g: GaussianInputs, opt: RasterOptions) -> None:
        g.validate()
        check_offered(self.info, required_features(g, opt))
        if g.scale_factors is not None:
            raise CapabilityError(
                f"rasterizer '{self.info.name}' does not offer INDEXED_GEOM (scale_factors); "
                "`sw list-plugins` shows which one does",
                missing={"INDEXED_GEOM"},
            )
        if opt.profile not in PROFILES:
            raise ConfigError(
                f"rasterizer '{self.info.name}' knows no profile '{opt.profile}'; one of {', '.join(PROFILES)}",
                key="raster.profile",
            )
        if opt.clamp_grad not in ("exact", "pass"):
            raise ConfigError(f"clamp_grad is '{opt.clamp_grad}', must be 'exact' or 'pass'")
        self._check_device(g)

    def _check_device(self, g: GaussianInputs) -> None:
        if g.means.device.type not in self.info.devices:
            raise CapabilityError(
                f"rasterizer '{self.info.name}' draws on {', '.join(sorted(self.info.devices))}, "
                f"the Gaussians are on {g.means.device}",
                missing=(),
            )
        name = str(g.means.dtype).removeprefix("torch.")
        mixed = {t.dtype for t in g.tensors().values() if t.is_floating_point()} != {g.means.dtype}
        if name not in self.info.dtypes or mixed:
            raise ShapeError(
                f"rasterizer '{self.info.name}' needs all tensors in one dtype of {', '.join(sorted(self.info.dtypes))}"
            )

    def _call(self, g: GaussianInputs, cam: Camera, opt: RasterOptions) -> Call:
        quirks = opt.profile == "dgr-exact"
        flags = Flag(0)
        for asked, flag in (
            (opt.antialias, Flag.ANTIALIAS),
            (opt.clamp_color, Flag.CLAMP_COLOR),
            (not quirks, Flag.TIGHT),
            (quirks or opt.clamp_grad == "pass", Flag.PASS_CLAMP),
            (quirks, Flag.ORIGINAL_JACOBIAN),
            ("inverse" in opt.depth, Flag.INVERSE_DEPTH),
            (bool(opt.depth & {"accumulated", "expected"}), Flag.ACCUMULATED_DEPTH),
            ("median" in opt.depth, Flag.MEDIAN_DEPTH),
            (opt.features_detach_geometry, Flag.DETACH_FEATURES),
            (opt.absgrad, Flag.ABSGRAD),
            (opt.alpha or "expected" in opt.depth, Flag.ALPHA_MAP),
            (self.count, Flag.COUNT),
        ):
            if asked:
                flags |= flag
        watch = torch.is_grad_enabled()
        return Call(
            camera_numbers(cam),
            cam.width,
            cam.height,
            0 if g.sh is None else g.sh.active_degree,
            opt.scale_modifier,
            opt.eps2d,
            flags,
            visible=_as_bytes(g.visible),
            background=_background(g, cam, opt),
            grad2d=GradBuffer() if watch and opt.grad2d else None,
            absgrad2d=GradBuffer() if watch and opt.absgrad else None,
        )


def _as_bytes(mask: Tensor | None) -> Tensor | None:
    return None if mask is None else mask.to(torch.bool).contiguous().view(torch.uint8)


def _background(g: GaussianInputs, cam: Camera, opt: RasterOptions) -> Tensor | None:
    """[C] or [C,H,W] in the dtype of the means."""
    if opt.background is None:
        return None
    channels = 3 if g.colors is None else g.colors.shape[1]
    background = opt.background.detach().to(g.means).contiguous()
    if background.shape not in ((channels,), (channels, cam.height, cam.width)):
        raise ShapeError(
            f"background must be [{channels}] or [{channels}, {cam.height}, {cam.width}], got {list(background.shape)}",
            actual=background.shape,
            expected=(channels, cam.height, cam.width),
        )
    return background
