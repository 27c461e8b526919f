"""Differentiable rasterization by the compiled kernels (autograd functions)."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from splatwizard_core.api import Camera, GradBuffer
from splatwizard_native import offered_update
from sw_rasterizers.native import MODULE

INPUTS = (
    "means", "opacities", "scales", "quats", "cov3d", "sh", "sh_dc", "sh_rest", "colors", "features", "scale_factors",
)  # fmt: skip
"""Differentiable inputs in the order in which the ops take them and return their gradients."""

UPDATED = ("sh_dc", "sh_rest")
"""Inputs for which the backward pass on CUDA can do Adam's step (`splatwizard_native.offer_update`)."""

FORWARD_STAGES = ("project", "sort", "bin", "blend")
BACKWARD_STAGES = ("blend_backward", "project_backward")


class Flag(enum.IntFlag):
    """Flags of one call; the part of `Flag` in csrc/binding.h that Python sets."""

    ANTIALIAS = 1
    CLAMP_COLOR = 2
    TIGHT = 4
    PASS_CLAMP = 8
    INVERSE_DEPTH = 16
    ACCUMULATED_DEPTH = 32
    MEDIAN_DEPTH = 64
    DETACH_FEATURES = 128
    ABSGRAD = 256
    ALPHA_MAP = 512
    SAVE = 1024
    COUNT = 2048
    ORIGINAL_JACOBIAN = 4096
    FLASH = 8192  # CUDA only
    TENSOR_CORES = 16384
    BYTES = 32768
    ORDERED = 131072
    FRAGMENTS = 262144  # with ABSGRAD: other sums in its two columns


@dataclass
class _Drawn:
    """Results of the forward op; `saved` is for the backward pass."""

    image: Tensor
    radii: Tensor
    alpha: Tensor
    median: Tensor
    saved: list[Tensor]


@dataclass
class Call:
    """Non-differentiable arguments of one call, and buffers for its by-products.

    camera          18 numbers: R, tau, fx, fy, cx, cy, near, far
    geom_indices    [N] int64, rows of scales and quats, none outside: the kernels do not look
    seconds         stage -> seconds, filled by the forward pass, on the CPU also by the backward pass
    counts          visible Gaussians, (splat, tile) pairs, evaluated and blended pixel-splat pairs (-1 unless counted),
                    inputs that are not finite
    """

    camera: list[float]
    width: int
    height: int
    sh_degree: int
    scale_modifier: float
    eps2d: float
    flags: Flag
    geom_indices: Tensor | None = None
    visible: Tensor | None = None
    background: Tensor | None = None
    grad2d: GradBuffer | None = None
    absgrad2d: GradBuffer | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    counts: list[int] = field(default_factory=list)

    def settings(self) -> tuple[Any, ...]:
        return self.camera, self.width, self.height, self.sh_degree, self.scale_modifier, self.eps2d, int(self.flags)


def camera_numbers(cam: Camera) -> list[float]:
    """Return the camera as [18] numbers: R row by row, tau, fx, fy, cx, cy, near, far."""
    return [*cam.pose, cam.fx, cam.fy, cam.cx, cam.cy, cam.near, cam.far]


class _Rasterize(torch.autograd.Function):
    """On the CPU: (call, dummy, *INPUTS) -> image [C,H,W], radii [N] int32, alpha and median depth [0 or 1,H,W]."""

    @staticmethod
    def forward(ctx: Any, call: Call, dummy: Tensor | None, *inputs: Tensor | None) -> tuple[Tensor, ...]:
        tensors = [None if x is None else x.detach().contiguous() for x in inputs]
        drawn = _draw(call, tensors)
        ctx.call = call
        ctx.mark_non_differentiable(drawn.radii)
        ctx.set_materialize_grads(False)
        # All state goes through save_for_backward, so that it is freed with the graph even if the result lives on.
        ctx.present = [x is not None for x in tensors]
        ctx.save_for_backward(*(x for x in tensors if x is not None), *drawn.saved)
        return drawn.image, drawn.radii, drawn.alpha, drawn.median

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        image, _, alpha, median = grads
        call: Call = ctx.call
        stored = list(ctx.saved_tensors)
        tensors = [stored.pop(0) if present else None for present in ctx.present]
        if image is None:
            means = tensors[0]
            assert means is not None
            image = means.new_zeros(_channels(tensors, call.flags), call.height, call.width)
        wanted = [*ctx.needs_input_grad[2:], call.grad2d is not None, call.absgrad2d is not None]
        found, seconds = torch.ops.sw_rasterizers.render_backward(
            *tensors, call.geom_indices, call.visible, call.background, *call.settings(), stored, image.contiguous(),
            _nonempty(alpha), _nonempty(median), wanted,
        )  # fmt: skip
        call.seconds.update(zip(BACKWARD_STAGES, seconds, strict=False))
        return _hand_out(call, found, wanted)


def _updates(tensors: dict[str, Tensor | None]) -> tuple[list[Tensor], list[float]]:
    """Return tensors and rates of the Adam updates of sh_dc and sh_rest to fuse into backward on CUDA, if any."""
    offers = [None if (param := tensors.get(name)) is None else offered_update(param) for name in UPDATED]
    if all(u is None for u in offers):
        return [], []
    updated: list[Tensor] = []
    rates: list[float] = []
    for name, u in zip(UPDATED, offers, strict=True):
        param = tensors.get(name)
        if param is None or u is None:
            updated += [torch.empty(0)] * 3
            rates += [0.0] * 6
            continue
        updated += [param, u.exp_avg, u.exp_avg_sq]
        rates += [
            u.lr / (1 - u.beta1**u.step),
            1 - u.beta1,
            u.beta2,
            1 - u.beta2,
            1 / math.sqrt(1 - u.beta2**u.step),
            u.eps,
        ]
    return updated, rates


def _draw_on_cuda(call: Call, tensors: dict[str, Tensor | None]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Render with gradients on CUDA; the autograd nodes are in C++ (csrc/binding_draw_cuda.cpp)."""
    image, radii, alpha, median, call.counts, seconds, late = torch.ops.sw_rasterizers.draw(
        *map(tensors.get, INPUTS), call.geom_indices, call.visible, call.background, *call.settings(),
        call.grad2d is not None, call.absgrad2d is not None, *_updates(tensors),
    )  # fmt: skip
    call.seconds.update(zip(FORWARD_STAGES, seconds, strict=False))
    for buffer in (call.grad2d, call.absgrad2d):
        if buffer is not None:
            buffer.set(late.pop(0))
    return image, radii, alpha, median


def backward_seconds() -> dict[str, float]:
    """Seconds of each stage of the last backward pass of a counting rasterizer on CUDA; none without CUDA."""
    if not MODULE.has_cuda():
        return {}
    return dict(zip(BACKWARD_STAGES, torch.ops.sw_rasterizers.backward_seconds(), strict=False))


def _hand_out(call: Call, found: list[Tensor], wanted: list[bool]) -> tuple[Tensor | None, ...]:
    """Return gradients in the order of the node's inputs; write statistics into their buffers."""
    for buffer, value in ((call.grad2d, found[-2]), (call.absgrad2d, found[-1])):
        if buffer is not None:
            buffer.set(value)
    return (None, None, *(g if want else None for g, want in zip(found, wanted[: len(INPUTS)], strict=False)))


def _draw(call: Call, tensors: list[Tensor | None]) -> _Drawn:
    image, radii, alpha, median, saved, call.counts, seconds = torch.ops.sw_rasterizers.render(
        *tensors, call.geom_indices, call.visible, call.background, *call.settings()
    )
    call.seconds.update(zip(FORWARD_STAGES, seconds, strict=False))  # on CUDA only if counting
    return _Drawn(image, radii, alpha, median, saved)


def _nonempty(x: Tensor | None) -> Tensor | None:
    return None if x is None or x.numel() == 0 else x.contiguous()


def _channels(tensors: list[Tensor | None], flags: Flag) -> int:
    colors, features = (tensors[INPUTS.index(name)] for name in ("colors", "features"))
    depths = (Flag.INVERSE_DEPTH in flags) + (Flag.ACCUMULATED_DEPTH in flags)
    return (3 if colors is None else colors.shape[1]) + depths + (0 if features is None else features.shape[1])


def rasterize(call: Call, tensors: dict[str, Tensor | None]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Render one view. Differentiable with respect to every tensor of INPUTS; all of one dtype and device.

    Returns the channels [C + depths + E, H, W] (colours over the background, then inverse and accumulated depth if
    flagged, then features), radii [N] int32, alpha [1,H,W] or [0,H,W], median depth likewise.
    State for the backward pass is kept only if something needs a gradient.
    """
    MODULE.load()
    inputs = [tensors.get(name) for name in INPUTS]
    recording = torch.is_grad_enabled()
    differentiable = recording and any(x is not None and x.requires_grad for x in inputs)
    if not differentiable and not (recording and (call.grad2d is not None or call.absgrad2d is not None)):
        drawn = _draw(call, [None if x is None else x.detach().contiguous() for x in inputs])
        return drawn.image, drawn.radii, drawn.alpha, drawn.median
    means = tensors["means"]
    assert means is not None
    if means.is_cuda:
        return _draw_on_cuda(call, tensors)
    call.flags |= Flag.SAVE
    # Statistics are wanted even if no input needs a gradient.
    dummy = None if differentiable else torch.empty(0, requires_grad=True)
    return _Rasterize.apply(call, dummy, *inputs)  # type: ignore[no-any-return]


def visible_radii(
    means: Tensor,
    scales: Tensor | None,
    quats: Tensor | None,
    cov3d: Tensor | None,
    visible: Tensor | None,
    cam: Camera,
    *,
    scale_factors: Tensor | None = None,
    geom_indices: Tensor | None = None,
) -> Tensor:
    """Return radii [N] int32, px, from geometry alone; 0 = culled. No gradient."""
    MODULE.load()
    tensors = (means, scales, quats, cov3d, scale_factors, geom_indices, visible)
    geometry = [None if x is None else x.detach().contiguous() for x in tensors]
    found: Tensor = torch.ops.sw_rasterizers.visible_radii(
        *geometry, camera_numbers(cam), cam.width, cam.height, 1.0, 0.3
    )
    return found
