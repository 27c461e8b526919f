"""The photometric loss of 3DGS, L1 and SSIM, as fused kernels in float32 and in plain torch everywhere else."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)

from splatwizard_core.errors import ShapeError
from splatwizard_core.training.native import TRAINING

Padding = Literal["same", "valid"]

RADIUS = 5  # 11 x 11 window
SIGMA = 1.5
C1 = 0.01**2
C2 = 0.03**2


@dataclass
class LossPack:
    """The loss of one step: `total` is what backward starts from, `parts` are what the log shows (scalars)."""

    total: Tensor
    parts: dict[str, Tensor] = field(default_factory=dict)


def photometric_loss(
    image: Tensor,
    target: Tensor,
    *,
    lambda_dssim: float = 0.2,
    clamp: bool = False,
    padding: Padding = "same",
) -> LossPack:
    """Return the 3DGS loss (1 - lambda) mean|image - target| + lambda (1 - SSIM).

    SSIM is the mean over window 11 x 11 Gaussian with sigma 1.5, per channel; moments as E[ab] - E[a]E[b], not clamped.
    In float32 fused kernels compute both (differentiable in `image` alone; if `target` needs a gradient the torch path
    is taken).

    image           [..., H, W] the render, float32 or float64, differentiable
    target          the photograph, 0..1, alike in shape, dtype and device
    lambda_dssim    weight of the SSIM term, 0..1
    clamp           clamp the render to 0..1 first, with no gradient outside (the 2024 code of 3DGS); the paper's
                    code did not
    padding         of SSIM: "same" as published, zeros beside the image; "valid" as some fast trainers: only where
                    the window fits

    Returns the total and, detached, the parts "l1" and "ssim". Raises ShapeError if the images differ, or if the window
    does not fit a "valid" one.
    Source: 3DGS (arXiv 2308.04079), equation 7; Wang et al. 2004.
    """
    _check(image, target, padding)
    if clamp:
        image = image.clamp(0.0, 1.0)
    node = _fused(image, target)
    if node is not None:
        total, l1, similarity = node.apply(  # type: ignore[no-untyped-call]
            image, target, padding == "valid", 1.0 - lambda_dssim, -lambda_dssim, lambda_dssim
        )
    else:
        l1 = (image - target).abs().mean()
        similarity = _ssim_torch(image, target, padding)
        total = (1.0 - lambda_dssim) * l1 + lambda_dssim * (1.0 - similarity)
    return LossPack(total, {"l1": l1.detach(), "ssim": similarity.detach()})


class _Photometric(torch.autograd.Function):
    """offset + l1_weight * L1 + ssim_weight * SSIM, and both means. The gradient is computed along with the value."""

    @staticmethod
    def forward(
        ctx: Any, x: Tensor, y: Tensor, valid: bool, l1_weight: float, ssim_weight: float, offset: float
    ) -> tuple[Tensor, Tensor, Tensor]:
        images = [t.reshape(-1, *t.shape[-2:]).contiguous() for t in (x, y)]
        l1, similarity, grad = torch.ops.splatwizard_training.photometric(
            *images, valid, l1_weight, ssim_weight, ctx.needs_input_grad[0]
        )
        ctx.save_for_backward(grad.view(x.shape) if ctx.needs_input_grad[0] else None)
        parts = x.new_tensor(l1), x.new_tensor(similarity)
        ctx.mark_non_differentiable(*parts)
        return x.new_tensor(offset + l1_weight * l1 + ssim_weight * similarity), *parts

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_output: Tensor, *_: Tensor) -> tuple[Tensor | None, ...]:
        (grad,) = ctx.saved_tensors
        # Nearly always the loss itself is differentiated: then there is nothing to multiply.
        scaled = grad if grad is None or float(grad_output) == 1.0 else grad * grad_output
        return scaled, None, None, None, None, None


class _PhotometricOnCuda(torch.autograd.Function):
    """The same on a GPU, where no number is waited for: the gradient is put together when its scale is known."""

    @staticmethod
    def forward(
        ctx: Any, x: Tensor, y: Tensor, valid: bool, l1_weight: float, ssim_weight: float, offset: float
    ) -> tuple[Tensor, Tensor, Tensor]:
        images = [t.detach().reshape(-1, *t.shape[-2:]).contiguous() for t in (x, y)]
        ctx.settings = valid, l1_weight, ssim_weight
        means, slopes = torch.ops.splatwizard_training.photometric_means(
            *images, *ctx.settings, offset, ctx.needs_input_grad[0]
        )
        ctx.save_for_backward(*images, slopes)
        ctx.shape = x.shape
        total, l1, similarity = means.unbind()
        ctx.mark_non_differentiable(l1, similarity)
        return total, l1, similarity

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_output: Tensor, *_: Tensor) -> tuple[Tensor | None, ...]:
        grad = torch.ops.splatwizard_training.photometric_backward(
            *ctx.saved_tensors, grad_output.contiguous(), *ctx.settings
        )
        return grad.view(ctx.shape), None, None, None, None, None


def _ssim_torch(x: Tensor, y: Tensor, padding: Padding) -> Tensor:
    height, width = x.shape[-2:]
    moments = torch.stack([x, y, x * x, y * y, x * y]).reshape(1, -1, height, width)  # [1, 5C, H, W]
    planes = moments.shape[1]
    offsets = torch.arange(-RADIUS, RADIUS + 1, dtype=x.dtype, device=x.device)
    window = torch.exp(-(offsets**2) / (2 * SIGMA**2))
    window = (window / window.sum()).expand(planes, 1, 1, -1)
    rows, columns = (RADIUS, RADIUS) if padding == "same" else (0, 0)
    # Grouped: as a batch of one-channel images it would miss the depthwise kernel of torch on the CPU.
    blurred = F.conv2d(moments, window, padding=(0, columns), groups=planes)
    blurred = F.conv2d(blurred, window.transpose(2, 3), padding=(rows, 0), groups=planes)
    mx, my, xx, yy, xy = blurred.view(5, -1, *blurred.shape[-2:])
    luminance = (2 * mx * my + C1) / (mx * mx + my * my + C1)
    structure = (2 * (xy - mx * my) + C2) / (xx - mx * mx + yy - my * my + C2)
    similarity: Tensor = (luminance * structure).mean()
    return similarity


def _fused(x: Tensor, y: Tensor) -> type[torch.autograd.Function] | None:
    """Return the fused loss that takes these images; None: torch operations do."""
    if x.dtype != torch.float32 or y.requires_grad:
        return None
    if x.is_cuda:
        return _PhotometricOnCuda if TRAINING.has_cuda() else None
    return _Photometric if x.device.type == "cpu" and TRAINING.try_load() else None


def _check(x: Tensor, y: Tensor, padding: str) -> None:
    if padding not in ("same", "valid"):
        raise ValueError(f"padding is '{padding}'; it must be 'same' or 'valid'")
    if x.shape != y.shape or x.dim() < 2:
        raise ShapeError(
            f"the two images are {list(x.shape)} and {list(y.shape)}; they must be alike, [..., H, W]",
            actual=y.shape,
            expected=tuple(x.shape),
        )
    if x.dtype != y.dtype or x.device != y.device:
        raise ShapeError(f"the two images are {x.dtype} on {x.device} and {y.dtype} on {y.device}; they must be alike")
    least = 1 if padding == "same" else 2 * RADIUS + 1
    if min(x.shape[-2:]) < least or x.numel() == 0:
        raise ShapeError(
            f"an image of {x.shape[-1]} x {x.shape[-2]} pixels is too small for SSIM with padding '{padding}'; "
            f"it takes at least {least} x {least}",
            actual=x.shape,
        )
