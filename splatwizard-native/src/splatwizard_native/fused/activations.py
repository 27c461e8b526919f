"""The activations of a model of Gaussians: one kernel for both on CUDA, torch operations everywhere else."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from splatwizard_native.fused import cuda_face
from splatwizard_native.fused.native import TRAINING


def activated(log_scales: Tensor, opacity_logits: Tensor) -> tuple[Tensor, Tensor]:
    """Return (exp of the log scales, sigmoid of the opacity logits), differentiable.

    Both of any shape, in float32 on one GPU for the kernel, whose values are those of torch to the last bit but one.
    """
    both = log_scales, opacity_logits
    if all(t.is_cuda and t.dtype == torch.float32 for t in both) and TRAINING.has_cuda():
        if not torch.is_grad_enabled():
            return _activate(log_scales.contiguous(), opacity_logits.contiguous())
        found: tuple[Tensor, Tensor] = _Activate.apply(*both)  # type: ignore[no-untyped-call]
        return found
    return torch.exp(log_scales), torch.sigmoid(opacity_logits)


def activation_gradients(
    scales: Tensor, opacities: Tensor, by_scales: Tensor | None, by_opacities: Tensor | None
) -> tuple[Tensor | None, Tensor | None]:
    """Return the gradients by what `activated` was given, from its results and the gradients by these, contiguous.

    By torch, and so to be differentiated again, where autograd records; elsewhere the kernel's if there is one.
    """
    given = by_scales, by_opacities
    if torch.is_grad_enabled() or not (scales.is_cuda and scales.dtype == torch.float32 and TRAINING.has_cuda()):
        sigmoid_backward = torch.ops.aten.sigmoid_backward
        by_logits = None if by_opacities is None else sigmoid_backward(by_opacities, opacities)
        return None if by_scales is None else by_scales * scales, by_logits
    made = [None if g is None else torch.empty_like(g) for g in given]
    cuda_face.activate_backward(
        scales=scales, opacities=opacities, by_scales=by_scales, by_opacities=by_opacities, by_log_scales=made[0],
        by_logits=made[1], scale_count=0 if by_scales is None else scales.numel(),
        opacity_count=0 if by_opacities is None else opacities.numel(),
    )  # fmt: skip
    return made[0], made[1]


def _activate(log_scales: Tensor, logits: Tensor) -> tuple[Tensor, Tensor]:
    scales, opacities = torch.empty_like(log_scales), torch.empty_like(logits)
    cuda_face.activate(
        log_scales=log_scales, logits=logits, scale_count=scales.numel(), opacity_count=opacities.numel(),
        scales=scales.data_ptr(), opacities=opacities.data_ptr(),
    )  # fmt: skip
    return scales, opacities


class _Activate(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, log_scales: Tensor, logits: Tensor) -> tuple[Tensor, Tensor]:
        scales, opacities = _activate(log_scales.contiguous(), logits.contiguous())
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(scales, opacities)
        return scales, opacities

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        wanted = zip(grads, ctx.needs_input_grad, strict=True)
        given = [g.contiguous() if g is not None and asked else None for g, asked in wanted]
        return activation_gradients(*ctx.saved_tensors, *given)
