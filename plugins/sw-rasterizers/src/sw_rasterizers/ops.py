"""Differentiable rasterization by the compiled kernels (autograd functions)."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from splatwizard_core.api import Camera
from splatwizard_native import offered_update
from sw_rasterizers import cpu
from sw_rasterizers.call import BACKWARD_STAGES, FORWARD_STAGES, INPUTS, Call, Flag, camera_numbers
from sw_rasterizers.native import MODULE, cuda_ops

UPDATED = ("sh_dc", "sh_rest")
"""Inputs for which the backward pass on CUDA can do Adam's step (`splatwizard_native.offer_update`)."""


class _Rasterize(torch.autograd.Function):
    """On the CPU: (call, dummy, *INPUTS) -> image [C,H,W], radii [N] int32, alpha and median depth [1,H,W] or None."""

    @staticmethod
    def forward(ctx: Any, call: Call, dummy: Tensor | None, *inputs: Tensor | None) -> tuple[Tensor | None, ...]:
        tensors = [None if x is None else x.detach().contiguous() for x in inputs]
        named = dict(zip(INPUTS, tensors, strict=True))
        ctx.picture = cpu.Picture(call, named, int(call.flags))
        drawn = cpu.draw(ctx.picture, named)
        ctx.mark_non_differentiable(drawn.radii)
        ctx.set_materialize_grads(False)
        # All state goes through save_for_backward, so that it is freed with the graph even if the result lives on.
        ctx.sizes = drawn.kept.pairs, drawn.kept.sum_bytes
        ctx.save_for_backward(*tensors, drawn.kept.splats, drawn.kept.lists)
        return drawn.image, drawn.radii, drawn.alpha, drawn.median

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        image, _, alpha, median = (None if x is None else x.contiguous() for x in grads)
        picture: cpu.Picture = ctx.picture
        call = picture.call
        *stored, splats, lists = ctx.saved_tensors
        tensors = dict(zip(INPUTS, stored, strict=True))
        if image is None:
            image = stored[0].new_zeros(picture.channels, *picture.size)
        statistics = {"grad2d": call.grad2d, "absgrad2d": call.absgrad2d}
        wanted = {name for name, asked in zip(INPUTS, ctx.needs_input_grad[2:], strict=True) if asked}
        wanted |= {name for name, buffer in statistics.items() if buffer is not None}
        found = cpu.draw_backward(
            picture, tensors, cpu.Kept(splats, lists, *ctx.sizes), {"image": image, "alpha": alpha, "median": median},
            wanted,
        )  # fmt: skip
        for name, buffer in statistics.items():
            if buffer is not None:
                buffer.set(found[name])
        return None, None, *map(found.get, INPUTS)


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
    """Render with gradients on CUDA; the autograd nodes are in C++ (csrc/cuda/binding_draw_cuda.cpp)."""
    image, radii, alpha, median, call.counts, seconds, late = cuda_ops().draw(
        *map(tensors.get, INPUTS), call.geom_indices, call.visible, call.background, *call.settings(),
        call.grad2d is not None, call.absgrad2d is not None, *_updates(tensors),
    )  # fmt: skip
    call.seconds.update(zip(FORWARD_STAGES, seconds, strict=False))
    for buffer in (call.grad2d, call.absgrad2d):
        if buffer is not None:
            buffer.set(late.pop(0))
    return image, radii, alpha, median


def _draw_plainly_on_cuda(call: Call, tensors: dict[str, Tensor | None]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    image, radii, alpha, median, _, call.counts, seconds = cuda_ops().render(
        *map(tensors.get, INPUTS), call.geom_indices, call.visible, call.background, *call.settings()
    )
    call.seconds.update(zip(FORWARD_STAGES, seconds, strict=False))  # only if counting
    return image, radii, alpha, median


def backward_seconds() -> dict[str, float]:
    """Seconds of each stage of the last backward pass of a counting rasterizer on CUDA; none without CUDA."""
    if not MODULE.has_cuda():
        return {}
    return dict(zip(BACKWARD_STAGES, torch.ops.sw_rasterizers.backward_seconds(), strict=False))


def rasterize(call: Call, tensors: dict[str, Tensor | None]) -> tuple[Tensor, Tensor, Tensor | None, Tensor | None]:
    """Render one view. Differentiable with respect to every tensor of INPUTS; all of one dtype and device.

    Returns the channels [C + depths + E, H, W] (colours over the background, then inverse and accumulated depth if
    flagged, then features), radii [N] int32, alpha [1,H,W], median depth likewise, if flagged.
    State for the backward pass is kept only if something needs a gradient.
    """
    inputs = [tensors.get(name) for name in INPUTS]
    means = tensors["means"]
    assert means is not None
    recording = torch.is_grad_enabled()
    differentiable = recording and any(x is not None and x.requires_grad for x in inputs)
    if not differentiable and not (recording and (call.grad2d is not None or call.absgrad2d is not None)):
        plain = {name: None if x is None else x.detach().contiguous() for name, x in zip(INPUTS, inputs, strict=True)}
        if means.is_cuda:
            return _draw_plainly_on_cuda(call, plain)
        drawn = cpu.draw(cpu.Picture(call, plain, int(call.flags)), plain)
        return drawn.image, drawn.radii, drawn.alpha, drawn.median
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
    tensors = means, scales, quats, cov3d, scale_factors, geom_indices, visible
    geometry = [None if x is None else x.detach().contiguous() for x in tensors]
    if means.is_cuda:
        found: Tensor = cuda_ops().visible_radii(*geometry, camera_numbers(cam), cam.width, cam.height, 1.0, 0.3)
        return found
    *given, rows, mask = geometry
    call = Call(camera_numbers(cam), cam.width, cam.height, 0, 1.0, 0.3, Flag(0), geom_indices=rows, visible=mask)
    names = "means", "scales", "quats", "cov3d", "scale_factors"
    return cpu.visible_radii(call, dict(zip(names, given, strict=True)))
