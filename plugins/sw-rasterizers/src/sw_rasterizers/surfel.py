"""Rasterizer of surfels (2D Gaussian Splatting) on compiled CPU and CUDA kernels."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Sequence
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
    RenderResult,
)
from sw_rasterizers import cpu, cuda, plugin
from sw_rasterizers.call import INPUTS as INPUTS_OF_ALL
from sw_rasterizers.call import Call, Flag, as_bytes, camera_numbers, tensors_of
from sw_rasterizers.unrecorded import Gradients, Unrecorded

INPUTS = ("means", "opacities", "scales", "quats", "sh", "sh_dc", "sh_rest", "colors")
"""Differentiable inputs."""
OTHERS = {name: None for name in INPUTS_OF_ALL if name not in INPUTS}
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
        self._unrecorded = Unrecorded(self.info)

    def render(self, g: GaussianInputs, cam: Camera, opt: RasterOptions) -> RenderResult:
        """Render one view; see the protocol. Raises CapabilityError, ConfigError or ShapeError."""
        self.info.check_request(g, opt)
        if opt.eps2d != RasterOptions.eps2d:
            from sw_reference.surfels import warn_of_low_pass  # here: nearly nobody asks for it

            warn_of_low_pass(opt.eps2d)
        call = self._call(g, cam, opt, learns=torch.is_grad_enabled())
        image, radii, alpha, maps = _draw(call, tensors_of(g, INPUTS))
        return _result(g, opt, call, image, radii, alpha, _told_apart(maps, opt))

    def draw(self, g: GaussianInputs, cam: Camera, opt: RasterOptions) -> tuple[RenderResult, Gradients]:
        """Draw one view as `render` does, unknown to autograd; see `Unrecorded.draw`. Raises as `render`.

        Alpha and the maps of the result are leaves of autograd: gradients of theirs are taken into account.
        """
        make = functools.partial(self._call, g, cam, opt, learns=True)
        call, drawn, gradients = self._unrecorded.draw(g, cam, opt, tensors_of(g, INPUTS), make)
        image, radii, alpha, _, maps = drawn
        alpha = None if alpha is None else alpha.requires_grad_()
        leaves = {name: each.detach().requires_grad_() for name, each in _told_apart(maps, opt).items()}

        def with_maps(by_image: Tensor) -> dict[str, Tensor]:
            by_maps, slopes = None, {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}
            if maps is not None and slopes:
                by_maps = torch.zeros_like(maps, requires_grad=False)
                for name, slope in slopes.items():
                    by_maps[MAPS[name]] = slope
            return gradients(by_image, None if alpha is None else alpha.grad, by_maps)

        with torch.enable_grad():
            return _result(g, opt, call, image, radii, alpha, leaves), with_maps

    @torch.no_grad()
    def visible_filter(self, g: GaussianInputs, cam: Camera) -> Tensor:
        """Radii [N] int32 from means, scales and quats (opacities and colours are not looked at); 0 = culled."""
        self.info.check_geometry(g)
        geometry = [None if x is None else x.detach().contiguous() for x in (g.means, g.scales, g.quats)]
        visible, camera = as_bytes(g.visible), camera_numbers(cam)
        call = Call(camera, cam.width, cam.height, 0, 1.0, 0.0, Flag.SURFELS, visible=visible)
        on_device = cuda if g.means.is_cuda else cpu
        return on_device.visible_radii(call, dict(zip(("means", "scales", "quats"), geometry, strict=True)))

    @torch.no_grad()
    def accumulate(self, g: GaussianInputs, cams: Iterable[Camera], opt: RasterOptions) -> AccumOutput:
        """No score is declared: raises CapabilityError for any that is asked for."""
        self.info.check_offered(Feature.asked_by(opt) | Feature.SURFEL)
        return AccumOutput({})

    def _call(self, g: GaussianInputs, cam: Camera, opt: RasterOptions, *, learns: bool) -> Call:
        quirks = opt.profile == "dgr-exact"
        flags = Flag.SURFELS
        for asked, flag in (
            (opt.clamp_color, Flag.CLAMP_COLOR),
            (not quirks, Flag.TIGHT),
            (quirks or opt.clamp_grad == "pass", Flag.PASS_CLAMP),
            (opt.alpha or "expected" in opt.depth, Flag.ALPHA_MAP),
            (self.count, Flag.COUNT),
            (bool(opt.depth) or opt.normals or opt.distortion, Flag.WITH_MAPS),
            (torch.are_deterministic_algorithms_enabled(), Flag.ORDERED),
        ):
            if asked:
                flags |= flag
        background = opt.background_of(3, cam, g.means)
        return Call(
            camera_numbers(cam),
            cam.width,
            cam.height,
            0 if g.sh is None else g.sh.active_degree,
            opt.scale_modifier,
            0.0,
            flags,
            visible=as_bytes(g.visible),
            background=None if background is None else background.detach().contiguous(),
            grad2d=GradBuffer() if learns and opt.grad2d else None,
        )


def _told_apart(maps: Tensor | None, opt: RasterOptions) -> dict[str, Tensor]:
    """Return the maps [7,H,W] that options need, each [..., H, W], by name."""
    needed = {"accumulated" if mode == "expected" else mode for mode in opt.depth}
    needed |= {name for name in ("normals", "distortion") if getattr(opt, name)}
    return {} if maps is None else {name: maps[MAPS[name]] for name in sorted(needed)}


def _result(
    g: GaussianInputs,
    opt: RasterOptions,
    call: Call,
    image: Tensor,
    radii: Tensor,
    alpha: Tensor | None,
    maps: dict[str, Tensor],
) -> RenderResult:
    """Return the result of a drawing from its maps by name."""
    depth = {name: maps[name] for name in opt.depth if name != "expected"}
    if "expected" in opt.depth:
        assert alpha is not None
        depth["expected"] = maps["accumulated"] / alpha.clamp(min=1e-10)
    return RenderResult(
        image=image,
        radii=radii,
        inputs=g,
        alpha=alpha if opt.alpha else None,
        depth={name: depth[name] for name in sorted(opt.depth)},
        normals=maps.get("normals"),
        distortion=maps.get("distortion"),
        grad2d=call.grad2d,
        stats=call.stats(),
    )


class _DrawSurfels(torch.autograd.Function):
    """(call, dummy, *INPUTS) -> image [3,H,W], radii [N] int32, alpha [1,H,W] or None, maps [7,H,W] or None."""

    @staticmethod
    def forward(ctx: Any, call: Call, dummy: Tensor | None, *inputs: Tensor | None) -> tuple[Tensor | None, ...]:
        tensors = [None if x is None else x.detach().contiguous() for x in inputs]
        named = _named(tensors)
        ctx.set_materialize_grads(False)
        ctx.picture = cpu.Picture(call, named, int(call.flags))
        if named["means"].is_cuda:
            on_cuda = cuda.draw(ctx.picture, named)
            image, radii, alpha, maps, kept = on_cuda.image, on_cuda.radii, on_cuda.alpha, on_cuda.maps, on_cuda.kept
            saved: tuple[Tensor, ...] = () if kept is None else kept[:3]
            ctx.sizes = None if kept is None else kept.sizes
        else:
            drawn = cpu.draw(ctx.picture, named)
            image, radii, alpha, maps = drawn.image, drawn.radii, drawn.alpha, drawn.maps
            saved, ctx.sizes = drawn.kept[:2], drawn.kept[2:]
        ctx.mark_non_differentiable(radii)
        # All state goes through save_for_backward, so that it is freed with the graph even if the result lives on.
        ctx.save_for_backward(*tensors, *saved)
        return image, radii, alpha, maps

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        image, _, alpha, maps = (None if x is None else x.contiguous() for x in grads)
        call: Call = ctx.picture.call
        named, saved = _named(ctx.saved_tensors[: len(INPUTS)]), ctx.saved_tensors[len(INPUTS) :]
        means = named["means"]
        if image is None:
            image = means.new_zeros(3, call.height, call.width)
        wanted = {name for name, want in zip(INPUTS, ctx.needs_input_grad[2:], strict=True) if want}
        wanted |= {"grad2d"} if call.grad2d is not None else set()
        by = {"image": image, "alpha": alpha, "maps": maps}
        if image.is_cuda:
            rows = cuda.blend_backward(ctx.picture, len(means), cuda.Kept(*saved, ctx.sizes), by)
            gradients = cuda.project_backward(ctx.picture, named, saved[2], rows, wanted, maps=maps is not None)
        else:
            gradients = cpu.draw_backward(ctx.picture, named, cpu.Kept(*saved, *ctx.sizes), by, wanted)
        if call.grad2d is not None:
            call.grad2d.set(gradients["grad2d"])
        return None, None, *map(gradients.get, INPUTS)


def _named(tensors: Sequence[Tensor | None]) -> cpu.Tensors:
    return {**OTHERS, **dict(zip(INPUTS, tensors, strict=True))}


def _draw(call: Call, tensors: dict[str, Tensor | None]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return image, radii, alpha and maps; saves state for backward only if an input needs a gradient."""
    inputs = [tensors.get(name) for name in INPUTS]
    dummy = None
    if torch.is_grad_enabled():
        if call.grad2d is not None:
            dummy = torch.empty(0, requires_grad=True)  # the statistic is wanted even if no input needs a gradient
        if dummy is not None or any(x is not None and x.requires_grad for x in inputs):
            call.flags |= Flag.SAVE
    return _DrawSurfels.apply(call, dummy, *inputs)  # type: ignore[no-any-return]
