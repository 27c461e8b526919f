"""The standard 3DGS rasterizer on compiled CPU and CUDA kernels."""

from __future__ import annotations

import functools
from collections.abc import Iterable
from dataclasses import replace

import torch
from torch import Tensor

from splatwizard_core.api import (
    AccumOutput,
    Camera,
    CapabilityError,
    ConfigError,
    GaussianInputs,
    GradBuffer,
    RasterizerInfo,
    RasterOptions,
    RenderResult,
    ShapeError,
)
from sw_rasterizers import plugin
from sw_rasterizers.call import Call, Flag, as_bytes, camera_numbers, tensors_of
from sw_rasterizers.ops import rasterize, visible_radii
from sw_rasterizers.scoring import Totals, add_scores, check_count
from sw_rasterizers.unrecorded import Gradients, Unrecorded

CUDA_CHANNELS = 8
"""Channels blended per pass on CUDA: `kMaxChunk` of csrc/cuda/kernels.h."""


class StandardRasterizer:
    """Standard 3DGS with gradients of all inputs; float32, on the CPU also float64 for gradient checks.

    Profile "3dgs" draws the exact support of every splat, alpha >= 1/255 wherever it reaches, as the reference does.
    Profile "dgr-exact" also cuts each splat at the original's square of 16x16 tiles (3 sigma) and takes over the
    original's gradients through the clamps of alpha and of the Jacobian.
    Scores of Gaussians are formed in a pass of their own, and only where they are asked for.

    count   also count evaluated and blended pixel-splat pairs into the statistics, and on CUDA measure the stages;
            slow, for benchmarks
    """

    info: RasterizerInfo = RasterizerInfo.declared(plugin.register_rasterizers, "standard")

    def __init__(self, *, count: bool = False) -> None:
        self.count = count
        self._unrecorded = Unrecorded(self.info)

    def render(self, g: GaussianInputs, cam: Camera, opt: RasterOptions) -> RenderResult:
        """Render one view; see the protocol. Raises CapabilityError, ConfigError or ShapeError."""
        self.info.check_request(g, opt)
        if opt.scores or opt.fisher:
            found = self.accumulate(g, [cam], opt)
            result = self.render(g, cam, replace(opt, scores=(), fisher=False))
            return replace(result, scores=found.scores, fisher=found.fisher)
        call = self._call(g, cam, opt, learns=torch.is_grad_enabled())
        self._check(g, opt, call)
        return _result(g, opt, call, *rasterize(call, tensors_of(g)))

    def draw(self, g: GaussianInputs, cam: Camera, opt: RasterOptions) -> tuple[RenderResult, Gradients]:
        """Draw one view as `render` does, unknown to autograd; see `Unrecorded.draw`. Raises as `render`."""

        def call_of() -> Call:
            call = self._call(g, cam, opt, learns=True)
            self._check(g, opt, call)
            return call

        call, drawn, gradients = self._unrecorded.draw(g, cam, opt, tensors_of(g), call_of)
        return _result(g, opt, call, *drawn[:4]), gradients

    def _check(self, g: GaussianInputs, opt: RasterOptions, call: Call) -> None:
        if g.colors is not None and g.colors.shape[1] == 0 and g.features is None and not opt.depth:
            raise ShapeError("GaussianInputs.colors has no channel: there is nothing to draw")
        if (opt.absgrad or opt.fragment_grad) and g.means.is_cuda:
            _check_absgrad(g, call.flags)

    @torch.no_grad()
    def visible_filter(self, g: GaussianInputs, cam: Camera) -> Tensor:
        """Radii [N] int32 from means and covariances (opacities and colours are not looked at); 0 = culled."""
        radii = self._unrecorded.radii(g, cam)
        if radii is not None:
            return radii
        self.info.check_geometry(g)
        return visible_radii(
            g.means, g.scales, g.quats, g.cov3d, as_bytes(g.visible), cam,
            scale_factors=g.scale_factors, geom_indices=g.geom_indices,
        )  # fmt: skip

    @torch.no_grad()
    def accumulate(self, g: GaussianInputs, cams: Iterable[Camera], opt: RasterOptions) -> AccumOutput:
        """Sum scores and Fisher blocks over views ("blend_max": their maximum); no image is kept."""
        self.info.check_request(g, opt)
        check_count(opt.scores)
        if g.colors is not None and g.colors.shape[1] == 0:
            raise ShapeError("GaussianInputs.colors has no channel: there is nothing to draw")
        totals = Totals(g, opt)
        plain = replace(opt, depth=frozenset(), alpha=False, absgrad=False, fragment_grad=False, grad2d=False)
        for cam in cams:
            opt.check_scores(cam)
            if opt.scores or opt.fisher:
                add_scores(g, self._call(g, cam, plain, learns=False), opt, totals)
        return totals.result()

    def _call(self, g: GaussianInputs, cam: Camera, opt: RasterOptions, *, learns: bool) -> Call:
        flags = _flags(
            opt.profile, opt.clamp_grad, frozenset(opt.depth), opt.antialias, opt.clamp_color,
            opt.features_detach_geometry, opt.absgrad, opt.fragment_grad, opt.alpha, self.count,
            torch.are_deterministic_algorithms_enabled(),
        )  # fmt: skip
        background = opt.background_of(3 if g.colors is None else g.colors.shape[1], cam, g.means)
        return Call(
            camera_numbers(cam),
            cam.width,
            cam.height,
            0 if g.sh is None else g.sh.active_degree,
            opt.scale_modifier,
            opt.eps2d,
            flags,
            geom_indices=None if g.geom_indices is None else g.geom_indices.contiguous(),
            visible=as_bytes(g.visible),
            background=None if background is None else background.detach().contiguous(),
            grad2d=GradBuffer() if learns and opt.grad2d else None,
            absgrad2d=GradBuffer() if learns and (opt.absgrad or opt.fragment_grad) else None,
        )


def _result(
    g: GaussianInputs,
    opt: RasterOptions,
    call: Call,
    image: Tensor,
    radii: Tensor,
    alpha: Tensor | None,
    median: Tensor | None,
) -> RenderResult:
    """Return the result of a drawing, its channels told apart."""
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
        assert alpha is not None
        depth["expected"] = depth["accumulated"] / alpha.clamp(min=1e-10)
    if median is not None and "median" in opt.depth:
        depth["median"] = median
    return RenderResult(
        image=image[:colors] if image.shape[0] > colors else image,
        radii=radii,
        inputs=g,
        alpha=alpha if opt.alpha else None,
        depth={name: depth[name] for name in sorted(opt.depth)},
        features=None if g.features is None else image[at:],
        grad2d=call.grad2d,
        absgrad2d=call.absgrad2d if opt.absgrad else None,
        fragment_grad=call.absgrad2d if opt.fragment_grad else None,
        stats=call.stats(),
    )


def _check_absgrad(g: GaussianInputs, flags: Flag) -> None:
    """Raise for more channels than one pass blends on CUDA, since absolute gradients do not add up over passes."""
    asked = "fragment_grad" if Flag.FRAGMENTS in flags else "absgrad"
    channels = 3 if g.colors is None else g.colors.shape[1]
    channels += (Flag.INVERSE_DEPTH in flags) + (Flag.ACCUMULATED_DEPTH in flags)
    channels += 0 if g.features is None else g.features.shape[1]
    if channels > CUDA_CHANNELS:
        raise CapabilityError(
            f"{asked} on CUDA is offered for up to {CUDA_CHANNELS} channels of colours, depths and features together, "
            f"here are {channels}",
            missing=frozenset({asked.upper()}),
        )


@functools.cache  # a training asks for the same at every step
def _flags(
    profile: str,
    clamp_grad: str,
    depth: frozenset[str],
    antialias: bool,
    clamp_color: bool,
    detach_features: bool,
    absgrad: bool,
    fragments: bool,
    alpha: bool,
    count: bool,
    ordered: bool,
) -> Flag:
    """Convert options to kernel flags. Raises ConfigError for options that exclude each other."""
    if absgrad and fragments:
        raise ConfigError("absgrad and fragment_grad take the place of each other: ask for one of them")
    quirks = profile == "dgr-exact"
    flags = Flag(0)
    for asked, flag in (
        (antialias, Flag.ANTIALIAS),
        (clamp_color, Flag.CLAMP_COLOR),
        (not quirks, Flag.TIGHT),
        (quirks or clamp_grad == "pass", Flag.PASS_CLAMP),
        (quirks, Flag.ORIGINAL_JACOBIAN),
        ("inverse" in depth, Flag.INVERSE_DEPTH),
        (bool(depth & {"accumulated", "expected"}), Flag.ACCUMULATED_DEPTH),
        ("median" in depth, Flag.MEDIAN_DEPTH),
        (detach_features, Flag.DETACH_FEATURES),
        (absgrad or fragments, Flag.ABSGRAD),
        (fragments, Flag.FRAGMENTS),
        (alpha or "expected" in depth, Flag.ALPHA_MAP),
        (count, Flag.COUNT),
        (ordered, Flag.ORDERED),
    ):
        if asked:
            flags |= flag
    return flags
