"""The photometric loss, L1 and SSIM, as fused kernels in float32 and in plain torch everywhere else."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, Literal

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)

from splatwizard_native.fused import cuda_face, face
from splatwizard_native.fused.native import TRAINING

Padding = Literal["same", "valid"]

TILE = 32  # pixels of a block of the CUDA kernel, each way
RADIUS = 5  # 11 x 11 window
SIGMA = 1.5
C1 = 0.01**2
C2 = 0.03**2


def photometric(
    image: Tensor, target: Tensor, lambda_dssim: float, padding: Padding = "same"
) -> tuple[Tensor, Tensor, Tensor]:
    """Return (1 - lambda) L1 + lambda (1 - SSIM), differentiable in `image`, and beside it L1 and SSIM, detached.

    In float32 fused kernels compute all three; if `target` needs a gradient the torch path is taken.

    image, target   [..., H, W], alike in shape, dtype and device, at least as large as the window if padding is "valid"
    padding         of SSIM: "same", zeros beside the image; "valid": only where the window fits
    Source: Wang et al. 2004: window 11 x 11, Gaussian with sigma 1.5, per channel; moments as E[ab] - E[a]E[b].
    """
    fused = _fused(image, target)
    if fused is not None:
        return fused(image, target, padding == "valid", 1.0 - lambda_dssim, -lambda_dssim, lambda_dssim)
    l1 = (image - target).abs().mean()
    similarity = ssim_map(image, target, padding).mean()
    return (1.0 - lambda_dssim) * l1 + lambda_dssim * (1.0 - similarity), l1.detach(), similarity.detach()


def photometric_gradient(
    image: Tensor, target: Tensor, lambda_dssim: float, padding: Padding = "same"
) -> tuple[Tensor, Tensor, Tensor, Tensor] | None:
    """Return what `photometric` does and the gradient by `image`, unknown to autograd; None: no kernel takes these."""
    if _fused(image, target) is None:
        return None
    weights = {"valid": padding == "valid", "l1_weight": 1.0 - lambda_dssim, "ssim_weight": -lambda_dssim}
    (total, l1, similarity), kept = _means(image, target, weights, lambda_dssim, learns=True)
    return total, l1, similarity, _gradient(kept, weights, _one(image.device)).view(image.shape)


def _means(
    x: Tensor, y: Tensor, weights: dict[str, Any], offset: float, *, learns: bool
) -> tuple[tuple[Tensor, ...], tuple[Any, ...]]:
    """Return the total and both means, each a tensor of its own, and what `_gradient` needs.

    On the CPU the gradient is computed along with the value; on CUDA no number is waited for, and the gradient is put
    together when its scale is known.
    """
    image, target = (t.reshape(-1, *t.shape[-2:]).contiguous() if t.dim() != 3 else t.contiguous() for t in (x, y))
    planes, height, width = image.shape
    if x.is_cuda:
        total, l1, similarity = found = tuple(image.new_empty(()) for _ in range(3))
        slopes = image.new_empty(3, *image.shape) if learns else None
        sums = image.new_empty(2 + 2 * planes * -(-height // TILE) * -(-width // TILE))
        cuda_face.photometric_loss(  # addresses of what is made here, which fits, spare its checks
            x=image, y=target, **weights, offset=offset, total=total.data_ptr(), l1=l1.data_ptr(),
            ssim=similarity.data_ptr(), slopes=None if slopes is None else slopes.data_ptr(), sums=sums.data_ptr(),
            sum_count=sums.numel(),
        )  # fmt: skip
        return found, (image, target, slopes)
    grad = torch.empty_like(image) if learns else None
    row_sums = image.new_empty(2, planes, height, dtype=torch.float64)
    told = face.photometric(x=image, y=target, **weights, grad=grad, row_sums=row_sums)
    total = offset + weights["l1_weight"] * told.l1 + weights["ssim_weight"] * told.ssim
    return tuple(map(x.new_tensor, (total, told.l1, told.ssim))), (grad,)


def _gradient(kept: Sequence[Tensor], weights: dict[str, Any], scale: Tensor) -> Tensor:
    """Return `scale` times the gradient of the total by the image, [planes, H, W]."""
    if scale.is_cuda:
        x, y, slopes = kept
        grad = torch.empty_like(x)
        cuda_face.photometric_loss_backward(x=x, y=y, slopes=slopes, **weights, scale=scale, grad=grad.data_ptr())
        return grad
    grad = kept[0]
    return grad if float(scale) == 1.0 else grad * scale  # nearly always the loss itself is differentiated


@functools.cache
def _one(device: torch.device) -> Tensor:
    return torch.ones((), device=device)


class _Photometric(torch.autograd.Function):
    """offset + l1_weight * L1 + ssim_weight * SSIM, and both means."""

    @staticmethod
    def forward(
        ctx: Any, learns: bool, x: Tensor, y: Tensor, valid: bool, l1_weight: float, ssim_weight: float, offset: float
    ) -> tuple[Tensor, ...]:
        ctx.weights, ctx.shape = {"valid": valid, "l1_weight": l1_weight, "ssim_weight": ssim_weight}, x.shape
        found, kept = _means(x, y, ctx.weights, offset, learns=learns)
        ctx.save_for_backward(*kept)
        ctx.mark_non_differentiable(*found[1:])
        return found

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, scale: Tensor, *_: Tensor) -> tuple[Tensor | None, ...]:
        return None, _gradient(ctx.saved_tensors, ctx.weights, scale).view(ctx.shape), *[None] * 5


def ssim_map(x: Tensor, y: Tensor, padding: Padding = "same") -> Tensor:
    """Return the structural similarity at each pixel, [..., H, W] -> [planes, H, W], in torch operations."""
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
    similarity: Tensor = luminance * structure
    return similarity


def _fused(x: Tensor, y: Tensor) -> Callable[..., tuple[Tensor, Tensor, Tensor]] | None:
    """Return the fused loss that takes these images; None: torch operations do."""
    if x.dtype != torch.float32 or y.requires_grad:
        return None
    fused = TRAINING.has_cuda() if x.is_cuda else x.device.type == "cpu" and TRAINING.try_load()
    return functools.partial(_Photometric.apply, torch.is_grad_enabled() and x.requires_grad) if fused else None
