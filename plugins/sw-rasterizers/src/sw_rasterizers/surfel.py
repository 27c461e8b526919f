"""Rasterizer of surfels (2D Gaussian Splatting) on compiled CPU and CUDA kernels."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

from splatwizard_core.api import (
    AccumOutput,
    Camera,
    Feature,
    GaussianInputs,
    GradBuffer,
    RasterizerInfo,
    RasterOptions,
    RasterStats,
    RenderResult,
)
from sw_rasterizers import plugin
from sw_rasterizers.native import MODULE
from sw_rasterizers.ops import BACKWARD_STAGES, FORWARD_STAGES, Call, Flag, camera_numbers

INPUTS = ("means", "opacities", "scales", "quats", "sh", "sh_dc", "sh_rest", "colors")
"""Differentiable inputs in the order in which the ops take them and return their gradients."""
WITH_MAPS = 1 << 20
"""Flag besides those of ops.py: also depth, normals and distortion; mirrors `kWithMaps` in csrc/binding_surfel.h."""
MAPS = {"accumulated": slice(0, 1), "inverse": slice(1, 2), "normals": slice(2, 5), "distortion": slice(5, 6),
        "median": slice(6, 7)}  # fmt: skip
"""Channels of the maps; mirrors `SurfelMap` in csrc/surfel.h."""


class SurfelRasterizer:
    """2DGS with gradients of all inputs; float32, on the CPU also float64 for gradient checks.

    Renders like the reference for scales [N,2]. Profile "3dgs" has the exact support of every surfel. Profile
    "dgr-exact" cuts surfels at the 16x16 tile squares of the published kernels, and passes gradients through the clamp
    of alpha. The depth gradient through the low-pass branch, which those kernels omit in part, stays exact. The
    densification statistic is the derivative with respect to a shift of the surfel on the screen.

    count   also count evaluated and blended pixel-surfel pairs into the statistics; slow, for benchmarks; on
            CUDA also the only way to the seconds of the stages, which wait for the device
    """

    info: RasterizerInfo = RasterizerInfo.declared(plugin.register_rasterizers, "2dgs")

    def __init__(self, *, count: bool = False) -> None:
        self.count = count

    def render(self, g: GaussianInputs, cam: Camera, opt: RasterOptions) -> RenderResult:
        """Render one view; see the protocol. Raises CapabilityError, ConfigError or ShapeError."""
        self.info.check_request(g, opt)
        if opt.eps2d != RasterOptions.eps2d:
            from sw_reference.surfels import warn_of_low_pass  # here: nearly nobody asks for it

            warn_of_low_pass(opt.eps2d)
        call, flags = self._call(g, cam, opt)
        sh = g.sh
        image, radii, alpha, maps = _draw(
            call,
            flags,
            {
                "means": g.means,
                "opacities": g.opacities,
                "scales": g.scales,
                "quats": g.quats,
                "sh": None if sh is None else sh.dense,
                "sh_dc": None if sh is None else sh.dc,
                "sh_rest": None if sh is None else sh.rest,
                "colors": g.colors,
            },
        )
        depth = {name: maps[MAPS[name]] for name in opt.depth if name != "expected"}
        if "expected" in opt.depth:
            depth["expected"] = maps[MAPS["accumulated"]] / alpha.clamp(min=1e-10)
        visible, pairs, evaluated, blended, invalid = call.counts
        return RenderResult(
            image=image,
            radii=radii,
            inputs=g,
            alpha=alpha if opt.alpha else None,
            depth={name: depth[name] for name in sorted(opt.depth)},
            normals=maps[MAPS["normals"]] if opt.normals else None,
            distortion=maps[MAPS["distortion"]] if opt.distortion else None,
            grad2d=call.grad2d,
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
        """Radii [N] int32 from means, scales and quats (opacities and colours are not looked at); 0 = culled."""
        self.info.check_geometry(g)
        MODULE.load()
        geometry = [None if x is None else x.detach().contiguous() for x in (g.means, g.scales, g.quats)]
        found: Tensor = torch.ops.sw_rasterizers.visible_surfel_radii(
            *geometry, _as_bytes(g.visible), camera_numbers(cam), cam.width, cam.height
        )
        return found

    @torch.no_grad()
    def accumulate(self, g: GaussianInputs, cams: Iterable[Camera], opt: RasterOptions) -> AccumOutput:
        """No score is declared: raises CapabilityError for any that is asked for."""
        self.info.check_offered(Feature.asked_by(opt) | Feature.SURFEL)
        return AccumOutput({})

    def _call(self, g: GaussianInputs, cam: Camera, opt: RasterOptions) -> tuple[Call, int]:
        quirks = opt.profile == "dgr-exact"
        flags = Flag(0)
        for asked, flag in (
            (opt.clamp_color, Flag.CLAMP_COLOR),
            (not quirks, Flag.TIGHT),
            (quirks or opt.clamp_grad == "pass", Flag.PASS_CLAMP),
            (opt.alpha or "expected" in opt.depth, Flag.ALPHA_MAP),
            (self.count, Flag.COUNT),
            (torch.are_deterministic_algorithms_enabled(), Flag.ORDERED),
        ):
            if asked:
                flags |= flag
        background = opt.background_of(3, cam, g.means)
        call = Call(
            camera_numbers(cam),
            cam.width,
            cam.height,
            0 if g.sh is None else g.sh.active_degree,
            opt.scale_modifier,
            0.0,
            flags,
            visible=_as_bytes(g.visible),
            background=None if background is None else background.detach().contiguous(),
            grad2d=GradBuffer() if torch.is_grad_enabled() and opt.grad2d else None,
        )
        return call, WITH_MAPS if opt.depth or opt.normals or opt.distortion else 0


def _as_bytes(mask: Tensor | None) -> Tensor | None:
    return None if mask is None else mask.to(torch.bool).contiguous().view(torch.uint8)


class _DrawSurfels(torch.autograd.Function):
    """(call, flags, dummy, *INPUTS) -> image [3,H,W], radii [N] int32, alpha [0 or 1,H,W], maps [0 or 7,H,W]."""

    @staticmethod
    def forward(ctx: Any, call: Call, flags: int, dummy: Tensor | None, *inputs: Tensor | None) -> tuple[Tensor, ...]:
        tensors = [None if x is None else x.detach().contiguous() for x in inputs]
        image, radii, alpha, maps, saved, call.counts, seconds = torch.ops.sw_rasterizers.render_surfels(
            *tensors, *_settings(call, flags)
        )
        call.seconds.update(zip(FORWARD_STAGES, seconds, strict=False))  # on CUDA only if counting
        ctx.call, ctx.flags = call, flags
        ctx.mark_non_differentiable(radii)
        ctx.set_materialize_grads(False)
        # All state goes through save_for_backward, so that it is freed with the graph even if the result lives on.
        ctx.present = [x is not None for x in tensors]
        ctx.save_for_backward(*(x for x in tensors if x is not None), *saved)
        return image, radii, alpha, maps

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        image, _, alpha, maps = (None if x is None or x.numel() == 0 else x.contiguous() for x in grads)
        call: Call = ctx.call
        stored = list(ctx.saved_tensors)
        tensors = [stored.pop(0) if present else None for present in ctx.present]
        if image is None:
            means = tensors[0]
            assert means is not None
            image = means.new_zeros(3, call.height, call.width)
        wanted = [*ctx.needs_input_grad[3:], call.grad2d is not None]
        found, seconds = torch.ops.sw_rasterizers.render_surfels_backward(
            *tensors, *_settings(call, ctx.flags), stored, image, alpha, maps, wanted
        )
        call.seconds.update(zip(BACKWARD_STAGES, seconds, strict=False))
        if call.grad2d is not None:
            call.grad2d.set(found[-1])
        return (None, None, None, *(g if want else None for g, want in zip(found, wanted[:-1], strict=False)))


def _settings(call: Call, flags: int) -> tuple[Any, ...]:
    return (call.visible, call.background, call.camera, call.width, call.height, call.sh_degree, call.scale_modifier,
            int(call.flags) | flags)  # fmt: skip


def _draw(call: Call, flags: int, tensors: dict[str, Tensor | None]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return image, radii, alpha and maps; saves state for backward only if an input needs a gradient."""
    MODULE.load()
    inputs = [tensors.get(name) for name in INPUTS]
    dummy = None
    if torch.is_grad_enabled():
        if call.grad2d is not None:
            dummy = torch.empty(0, requires_grad=True)  # the statistic is wanted even if no input needs a gradient
        if dummy is not None or any(x is not None and x.requires_grad for x in inputs):
            call.flags |= Flag.SAVE
    return _DrawSurfels.apply(call, flags, dummy, *inputs)  # type: ignore[no-any-return]
