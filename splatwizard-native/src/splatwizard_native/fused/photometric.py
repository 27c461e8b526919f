"""The photometric loss, L1 and SSIM, as fused kernels in float32 and in plain torch everywhere else."""

from __future__ import annotations

from typing import Any, Literal

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)

from splatwizard_native.fused import cuda_face, face
from splatwizard_native.fused.native import TRAINING
from splatwizard_native.repeated import Repeated

Padding = Literal["same", "valid"]

TILE = 32  # pixels of a block of the CUDA kernel, each way
RADIUS, SIGMA = 5, 1.5  # 11 x 11 window
C1, C2 = 0.01**2, 0.03**2

_LOSS = Repeated(cuda_face, "photometric_loss")


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
    image: Tensor, target: Tensor, lambda_dssim: float, padding: Padding = "same", *, learns: bool = True
) -> tuple[Tensor, Tensor, Tensor, Any] | None:
    """Return what `photometric` does and, if it `learns`, the gradient by `image`; None: no kernel takes these."""
    if not _has_kernel(image, target):
        return None
    x, y = (t.reshape(-1, *t.shape[-2:]).contiguous() if t.dim() != 3 else t.contiguous() for t in (image, target))
    planes, height, width = x.shape
    weights = dict[str, Any](valid=padding == "valid", l1_weight=1.0 - lambda_dssim, ssim_weight=-lambda_dssim)
    grad = torch.empty_like(x) if learns else None
    if x.is_cuda:  # no number is waited for
        found = x.new_empty(3)
        sums = 2 + 2 * planes * -(-height // TILE) * -(-width // TILE)
        scratch = x.new_empty(sums + (3 * x.numel() if learns else 0))
        form = x.shape, y.shape, y.dtype, x.get_device(), y.get_device(), lambda_dssim, padding, learns
        more = {"found": found, "grad": grad, "scratch": scratch, "scratch_count": scratch.numel()}
        _LOSS(lambda: {**weights, "offset": lambda_dssim}, form, x=x, y=y, **more)
        total, l1, similarity = found.unbind()
    else:
        told = face.photometric(x=x, y=y, **weights, grad=grad, row_sums=x.new_empty(2, planes, height).double())
        whole = lambda_dssim + weights["l1_weight"] * told.l1 + weights["ssim_weight"] * told.ssim
        total, l1, similarity = map(x.new_tensor, (whole, told.l1, told.ssim))
    return total, l1, similarity, None if grad is None else grad.view(image.shape)


class _Photometric(torch.autograd.Function):  # (learns, x, y, lambda, padding) -> total, L1, SSIM
    @staticmethod
    def forward(ctx: Any, learns: bool, *given: Any) -> tuple[Tensor, ...]:
        *found, grad = photometric_gradient(*given, learns=learns)  # type: ignore[misc]
        ctx.save_for_backward(grad)
        ctx.mark_non_differentiable(*found[1:])
        return found[0].clone(), *found[1:]  # as a view of all three it could not be added to in place

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, scale: Tensor, *_: Tensor) -> tuple[Tensor | None, ...]:
        (grad,) = ctx.saved_tensors  # times 1 nearly always, as a look shows where it waits for nobody
        return None, grad if scale.is_cpu and float(scale) == 1.0 else grad * scale, None, None, None


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
