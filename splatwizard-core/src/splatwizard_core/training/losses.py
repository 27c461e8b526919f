"""The photometric loss of 3DGS, L1 and SSIM."""

from __future__ import annotations

from dataclasses import dataclass, field

from torch import Tensor

from splatwizard_core.errors import ShapeError
from splatwizard_native import Padding, photometric

WINDOW = 11  # pixels


@dataclass
class LossPack:
    """Loss of one step: `total` is differentiated, `parts` are logged (scalars)."""

    total: Tensor
    parts: dict[str, Tensor] = field(default_factory=dict)


def photometric_loss(
    image: Tensor, target: Tensor, *, lambda_dssim: float = 0.2, clamp: bool = False, padding: Padding = "same"
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
    total, l1, similarity = photometric(image.clamp(0.0, 1.0) if clamp else image, target, lambda_dssim, padding)
    return LossPack(total, {"l1": l1, "ssim": similarity})


def _check(x: Tensor, y: Tensor, padding: str) -> None:
    if padding not in ("same", "valid"):
        raise ValueError(f"padding is '{padding}'; it must be 'same' or 'valid'")
    if x.shape != y.shape or x.dim() < 2:
        raise ShapeError(f"the two images are {list(x.shape)} and {list(y.shape)}; they must be alike, [..., H, W]")
    if x.dtype != y.dtype or x.device != y.device:
        raise ShapeError(f"the two images are {x.dtype} on {x.device} and {y.dtype} on {y.device}; they must be alike")
    least = 1 if padding == "same" else WINDOW
    if min(x.shape[-2:]) < least or x.numel() == 0:
        raise ShapeError(
            f"an image of {x.shape[-1]} x {x.shape[-2]} pixels is too small for SSIM with padding '{padding}'; "
            f"it takes at least {least} x {least}"
        )
