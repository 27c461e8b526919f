"""The photometric loss, L1 and SSIM, as fused kernels in float32 and in plain torch everywhere else."""

from __future__ import annotations

from collections.abc import Sequence
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
    if _has_kernel(image, target):
        given = torch.is_grad_enabled() and image.requires_grad, image, target, lambda_dssim, padding
        return _Photometric.apply(*given)  # type: ignore[no-any-return, no-untyped-call]
    l1 = (image - target).abs().mean()
    similarity = ssim_map(image, target, padding).mean()
    return (1.0 - lambda_dssim) * l1 + lambda_dssim * (1.0 - similarity), l1.detach(), similarity.detach()


def photometric_gradient(
    image: Tensor, target: Tensor, lambda_dssim: float, padding: Padding = "same"
) -> tuple[Tensor, Tensor, Tensor, Tensor] | None:
    """Return what `photometric` does and the gradient by `image`, unknown to autograd; None: no kernel takes these."""
    if not _has_kernel(image, target):
        return None
    (total, l1, similarity), weights, kept = _means(image, target, lambda_dssim, padding, learns=True)
    return total, l1, similarity, _gradient(weights, kept).view(image.shape)


def _means(
    x: Tensor, y: Tensor, lambda_dssim: float, padding: Padding, *, learns: bool
) -> tuple[tuple[Tensor, ...], dict[str, Any], tuple[Any, ...]]:
    """Return the total and both means, each a tensor of its own, and what `_gradient` needs: weights and tensors.

    On the CPU the gradient is computed along with the value; on CUDA no number is waited for, and the gradient is put
    together when its scale is known.
    """
    image, target = (t.reshape(-1, *t.shape[-2:]).contiguous() if t.dim() != 3 else t.contiguous() for t in (x, y))
    planes, height, width = image.shape
    weights = dict[str, Any](valid=padding == "valid", l1_weight=1.0 - lambda_dssim, ssim_weight=-lambda_dssim)
    if x.is_cuda:
        total, l1, similarity = found = tuple(image.new_empty(()) for _ in range(3))
        slopes = image.new_empty(3, *image.shape) if learns else None
        sums = image.new_empty(2 + 2 * planes * -(-height // TILE) * -(-width // TILE))
        cuda_face.photometric_loss(  # addresses of what is made here, which fits, spare its checks
            x=image, y=target, **weights, offset=lambda_dssim, total=total.data_ptr(), l1=l1.data_ptr(),
            ssim=similarity.data_ptr(), slopes=None if slopes is None else slopes.data_ptr(), sums=sums.data_ptr(),
            sum_count=sums.numel(),
        )  # fmt: skip
        return found, weights, (image, target, slopes)
    grad = torch.empty_like(image) if learns else None
    row_sums = image.new_empty(2, planes, height, dtype=torch.float64)
    told = face.photometric(x=image, y=target, **weights, grad=grad, row_sums=row_sums)
    whole = lambda_dssim + weights["l1_weight"] * told.l1 + weights["ssim_weight"] * told.ssim
    return tuple(map(x.new_tensor, (whole, told.l1, told.ssim))), weights, (grad,)


def _gradient(weights: dict[str, Any], kept: Sequence[Tensor], scale: Tensor | None = None) -> Tensor:
    """Return `scale`, or 1, times the gradient of the total by the image, [planes, H, W]."""
    if kept[0].is_cuda:
        x, y, slopes = kept
        grad = torch.empty_like(x)
        cuda_face.photometric_loss_backward(x=x, y=y, slopes=slopes, **weights, scale=scale, grad=grad.data_ptr())
        return grad
    return kept[0] if scale is None or float(scale) == 1.0 else kept[0] * scale  # 1 but for weighted losses


class _Photometric(torch.autograd.Function):  # (learns, x, y, lambda, padding) -> total, L1, SSIM
    @staticmethod
    def forward(
        ctx: Any, learns: bool, x: Tensor, y: Tensor, lambda_dssim: float, padding: Padding
    ) -> tuple[Tensor, ...]:
        ctx.shape, (found, ctx.weights, kept) = x.shape, _means(x, y, lambda_dssim, padding, learns=learns)
        ctx.save_for_backward(*kept)
        ctx.mark_non_differentiable(*found[1:])
        return found

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, scale: Tensor, *_: Tensor) -> tuple[Tensor | None, ...]:
        return None, _gradient(ctx.weights, ctx.saved_tensors, scale).view(ctx.shape), None, None, None


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


def _has_kernel(x: Tensor, y: Tensor) -> bool:
    """Whether the fused loss takes these images; else torch operations do."""
    if x.dtype != torch.float32 or y.requires_grad:
        return False
    return TRAINING.has_cuda() if x.is_cuda else x.device.type == "cpu" and TRAINING.try_load()
