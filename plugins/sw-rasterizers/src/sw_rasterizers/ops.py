"""Differentiable rasterization by the compiled kernels (autograd functions)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from splatwizard_core.api import Camera
from splatwizard_native import AdamUpdate, offered_update
from sw_rasterizers import cpu, cuda
from sw_rasterizers.call import INPUTS, Call, Flag, camera_numbers

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


class _RasterizeOnCuda(torch.autograd.Function):
    """On CUDA: (picture, updates, dummy, *INPUTS) -> as `_Rasterize`; `updates` are for the backward pass to do.

    Inputs go through save_for_backward, so that they are freed with the graph even if the result lives on. The lists
    are gone sooner, before there is room for the gradients of the inputs.
    """

    @staticmethod
    def forward(
        ctx: Any, picture: cpu.Picture, updates: dict[str, AdamUpdate], dummy: Tensor | None, *inputs: Tensor | None
    ) -> tuple[Tensor | None, ...]:
        tensors = [None if x is None else x.contiguous() for x in inputs]
        drawn = cuda.draw(picture, dict(zip(INPUTS, tensors, strict=True)))
        assert drawn.kept is not None
        ctx.picture, ctx.updates, ctx.kept = picture, updates, [drawn.kept]
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(drawn.radii)
        ctx.save_for_backward(*tensors)
        return drawn.image, drawn.radii, drawn.alpha, drawn.median

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        image, _, alpha, median = (None if x is None else x.contiguous() for x in grads)
        picture, updates = ctx.picture, ctx.updates
        tensors = dict(zip(INPUTS, ctx.saved_tensors, strict=True))
        if image is None:
            image = tensors["means"].new_zeros(picture.channels, *picture.size)
        wanted = {name for name, asked in zip(INPUTS, ctx.needs_input_grad[3:], strict=True) if asked}
        kept = ctx.kept if _KEEPS_GRAPH() else [ctx.kept.pop()]
        ctx.updates = {}
        by = {"image": image, "alpha": alpha, "median": median}
        found = gradients_on_cuda(picture, tensors, [*kept], by, wanted, updates)
        return None, None, None, *map(found.get, INPUTS)


_KEEPS_GRAPH: Callable[[], bool] = getattr(torch._C._autograd, "_get_current_graph_task_keep_graph", lambda: True)
"""Whether a backward pass under way may be followed by another one through the same nodes."""


def gradients_on_cuda(
    picture: cpu.Picture, tensors: cpu.Tensors, kept: list[Any], by: cpu.Tensors, wanted: set[str],
    updates: dict[str, AdamUpdate], again: cuda.Again | None = None,
) -> dict[str, Tensor]:  # fmt: skip
    """Return the gradients that are wanted, and fill the statistics of the call; `kept` is empty thereafter."""
    call, shown, means = picture.call, kept[0].drawn, tensors["means"]
    statistics = {"grad2d": call.grad2d, "absgrad2d": call.absgrad2d}
    wanted = wanted | {name for name, buffer in statistics.items() if buffer is not None}
    rows = cuda.blend_backward(picture, means.shape[0], kept.pop(), by, again)
    maps = by.get("maps") is not None
    found = cuda.project_backward(picture, tensors, shown, rows, wanted, updates, maps=maps, again=again)
    for name, buffer in statistics.items():
        if buffer is not None:
            buffer.set(found[name])
    return found


def updates_of(tensors: dict[str, Tensor | None]) -> dict[str, AdamUpdate]:
    """Return the Adam updates of sh_dc and sh_rest to fuse into the backward pass on CUDA."""
    offers = {name: offered_update(x) for name in UPDATED if (x := tensors.get(name)) is not None}
    return {name: u for name, u in offers.items() if u is not None}


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
        picture = cpu.Picture(call, plain, int(call.flags))
        drawn = cuda.draw(picture, plain) if means.is_cuda else cpu.draw(picture, plain)
        return drawn.image, drawn.radii, drawn.alpha, drawn.median
    call.flags |= Flag.SAVE
    # Statistics are wanted even if no input needs a gradient.
    dummy = None if differentiable else torch.empty(0, requires_grad=True)
    if means.is_cuda:
        named = dict(zip(INPUTS, inputs, strict=True))
        picture = cpu.Picture(call, named, int(call.flags))
        return _RasterizeOnCuda.apply(picture, updates_of(named), dummy, *inputs)  # type: ignore[no-any-return]
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
    *given, rows, mask = geometry
    call = Call(camera_numbers(cam), cam.width, cam.height, 0, 1.0, 0.3, Flag(0), geom_indices=rows, visible=mask)
    names = "means", "scales", "quats", "cov3d", "scale_factors"
    on_device = cuda if means.is_cuda else cpu
    return on_device.visible_radii(call, dict(zip(names, given, strict=True)))
