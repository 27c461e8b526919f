"""Differentiable rasterization by the compiled kernels (autograd functions)."""

from __future__ import annotations

from dataclasses import dataclass
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


@dataclass
class _Drawing:
    """A drawing on CUDA on its way from one node of autograd to the other.

    updates     of sh_dc and sh_rest, which the backward pass does where it finds their gradients
    """

    picture: cpu.Picture
    updates: dict[str, AdamUpdate]
    drawn: cuda.Drawn | None = None


class _Project(torch.autograd.Function):
    """First node on CUDA: a stand-in [N, sums of a Gaussian] without memory, whose gradient is what `_Blend` sums up.

    Two nodes, so that the lists are free again before there is room for the gradients of the inputs. All large state
    goes through save_for_backward, so that it is freed with the graph even if the result lives on.
    """

    @staticmethod
    def forward(ctx: Any, drawing: _Drawing, dummy: Tensor | None, *inputs: Tensor | None) -> Tensor:
        tensors = [None if x is None else x.detach().contiguous() for x in inputs]
        drawing.drawn = drawn = cuda.draw(drawing.picture, dict(zip(INPUTS, tensors, strict=True)))
        assert drawn.kept is not None
        ctx.drawing = drawing
        ctx.save_for_backward(*tensors, drawn.kept.drawn)
        radii = drawn.radii
        length = cuda.row_length(drawing.picture, radii.get_device())
        return radii.new_empty_strided((len(radii), length), (0, 0), dtype=torch.float32)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, rows: Tensor) -> tuple[Tensor | None, ...]:
        *stored, drawn = ctx.saved_tensors
        drawing: _Drawing = ctx.drawing
        call = drawing.picture.call
        statistics = {"grad2d": call.grad2d, "absgrad2d": call.absgrad2d}
        wanted = {name for name, asked in zip(INPUTS, ctx.needs_input_grad[2:], strict=True) if asked}
        wanted |= {name for name, buffer in statistics.items() if buffer is not None}
        tensors = dict(zip(INPUTS, stored, strict=True))
        found = cuda.project_backward(drawing.picture, tensors, drawn, rows.contiguous(), wanted, drawing.updates)
        drawing.updates = {}
        for name, buffer in statistics.items():
            if buffer is not None:
                buffer.set(found[name])
        return None, None, *map(found.get, INPUTS)


class _Blend(torch.autograd.Function):
    """Second node on CUDA: image [C,H,W], radii [N] int32, alpha and median depth [1,H,W] or None."""

    @staticmethod
    def forward(ctx: Any, drawing: _Drawing, stand_in: Tensor) -> tuple[Tensor | None, ...]:
        drawn = drawing.drawn
        assert drawn is not None
        assert drawn.kept is not None
        ctx.drawing, drawing.drawn = drawing, None
        ctx.count, ctx.sizes = len(stand_in), drawn.kept.sizes
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(drawn.radii)
        ctx.save_for_backward(drawn.kept.lists, drawn.kept.pair_splats)
        return drawn.image, drawn.radii, drawn.alpha, drawn.median

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        image, _, alpha, median = (None if x is None else x.contiguous() for x in grads)
        lists, pair_splats = ctx.saved_tensors
        picture: cpu.Picture = ctx.drawing.picture
        if image is None:
            image = lists.new_zeros((picture.channels, *picture.size), dtype=torch.float32)
        kept = cuda.Kept(lists, pair_splats, lists, ctx.sizes)
        return None, cuda.blend_backward(picture, ctx.count, kept, {"image": image, "alpha": alpha, "median": median})


def _updates(tensors: dict[str, Tensor | None]) -> dict[str, AdamUpdate]:
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
        drawing = _Drawing(cpu.Picture(call, named, int(call.flags)), _updates(named))
        return _Blend.apply(drawing, _Project.apply(drawing, dummy, *inputs))  # type: ignore[no-any-return]
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
