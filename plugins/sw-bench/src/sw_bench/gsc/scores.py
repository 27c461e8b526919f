"""Scores of a decoded view against the source's view, by the formulas of the exploration's metric tool.

Pictures are 8-bit RGB [3,H,W]. YUV is full-range BT.709, in floating point and not rounded. Where planes are equal a
PSNR has no value here (None); the tool gives 999.99.
Source: specification of the protocols, metrics as mpeg-gsc-metrics computes them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import conv2d, pad

PEAK = 255.0
EQUAL = 1e-12  # mean squared error, levels: the rows of chroma sum to 0 only up to rounding
FOREGROUND = 10  # of 255: opacity from which a pixel belongs to the object
WINDOW, SIGMA = 11, 1.5  # pixels
C1, C2 = (0.01 * PEAK) ** 2, (0.03 * PEAK) ** 2
LEAST_MASK = 0.5  # of a window's weight: below, the window is left out

YUV = torch.tensor([[0.2126, 0.7152, 0.0722], [-0.1146, -0.3854, 0.5], [0.5, -0.4542, -0.0458]], dtype=torch.float64)
OFFSETS = torch.tensor([0.0, 128.0, 128.0], dtype=torch.float64)
INTEGER_YUV = torch.tensor([[13933, 46871, 4732], [-7509, -25259, 32768], [32768, -29763, -3005]])
"""The same in 16-bit fixed point, as the tool's QMIV switch has it."""


@dataclass(frozen=True)
class ViewScore:
    """Scores of one view; PSNRs in dB, None where what they compare is equal.

    mse_rgb, mse_yuv    mean squared error of the three planes together, levels squared
    psnr_y, psnr_u, psnr_v      of each plane
    psnr_yuv_qmiv       (4 Y + U + V) / 6 of the PSNRs of integer planes; psnr_yuv_611: (6 Y + U + V) / 8 of the others
    ssim_yuv            mean of the three planes' SSIM
    om_psnr_rgb, om_ssim_yuv    over the object; None where there is none
    occupancy           share of the object in the picture, %
    """

    mse_rgb: float
    mse_yuv: float
    psnr_rgb: float | None
    psnr_yuv: float | None
    psnr_y: float | None
    psnr_u: float | None
    psnr_v: float | None
    psnr_yuv_qmiv: float | None
    psnr_yuv_611: float | None
    ssim_yuv: float
    om_psnr_rgb: float | None
    om_ssim_yuv: float | None
    occupancy: float


def score(source: Tensor, decoded: Tensor, mask: Tensor) -> ViewScore:
    """Compare two uint8 pictures [3,H,W]; `mask` [H,W] bool is the object."""
    a, b = source.double(), decoded.double()
    rgb = (a - b).square()
    planes = to_yuv(a), to_yuv(b)
    yuv = (planes[0] - planes[1]).square()
    of_planes = [psnr(plane.mean().item()) for plane in yuv]
    integers = [
        psnr(plane.mean().item()) for plane in (to_integer_yuv(source) - to_integer_yuv(decoded)).double().square()
    ]
    seen = bool(mask.any())
    whole = bool(mask.all())
    ssim = ssim_map(*planes).mean().item()
    return ViewScore(
        mse_rgb=rgb.mean().item(),
        mse_yuv=yuv.mean().item(),
        psnr_rgb=psnr(rgb.mean().item()),
        psnr_yuv=psnr(yuv.mean().item()),
        psnr_y=of_planes[0],
        psnr_u=of_planes[1],
        psnr_v=of_planes[2],
        psnr_yuv_qmiv=weighted(integers, (4, 1, 1)),
        psnr_yuv_611=weighted(of_planes, (6, 1, 1)),
        ssim_yuv=ssim,
        om_psnr_rgb=psnr(rgb[:, mask].mean().item()) if seen else None,
        om_ssim_yuv=ssim if whole else masked_ssim_yuv(*planes, mask) if seen else None,
        occupancy=100.0 * mask.double().mean().item(),
    )


def to_yuv(rgb: Tensor) -> Tensor:
    """Planes [3,H,W] float64 of RGB levels 0 .. 255."""
    return torch.einsum("ij,jhw->ihw", YUV.to(rgb.device), rgb) + OFFSETS.to(rgb.device)[:, None, None]


def to_integer_yuv(rgb: Tensor) -> Tensor:
    """Planes [3,H,W] int64 in 0 .. 255 of uint8 RGB."""
    exact = torch.einsum("ij,jhw->ihw", INTEGER_YUV.double().to(rgb.device), rgb.double())  # GPUs multiply no integers
    planes = (exact.long() + (1 << 15)) >> 16
    planes[1:] += 128
    return planes.clamp(0, 255)


def psnr(mse: float) -> float | None:
    """PSNR in dB of a mean squared error of levels; None if it is 0."""
    return None if mse < EQUAL else 10 * math.log10(PEAK**2 / mse)


def weighted(values: Iterable[float | None], weights: tuple[int, ...]) -> float | None:
    """Weighted mean; None if a value is."""
    found = 0.0
    for value, weight in zip(values, weights, strict=True):
        if value is None:
            return None
        found += weight * value
    return found / sum(weights)


def masked_ssim_yuv(a: Tensor, b: Tensor, mask: Tensor) -> float | None:
    """Mean over the planes [3,H,W] of their SSIM with the moments of the object; None where no window holds enough."""
    found = ssim_map(a, b, mask)
    return found.mean().item() if found.numel() else None


def ssim_map(a: Tensor, b: Tensor, mask: Tensor | None = None) -> Tensor:
    """SSIM at each pixel, [C,H,W] float64 -> [C,H,W]; with a mask [H,W] at windows that hold enough of it, [C,n]."""
    if mask is None:
        mean_a, mean_b = blur(a), blur(b)
        var_a, var_b = blur(a * a) - mean_a**2, blur(b * b) - mean_b**2
        covariance = blur(a * b) - mean_a * mean_b
    else:
        m = mask.to(a)[None]
        weight = blur(m)
        kept = weight[0] >= LEAST_MASK

        def mean(values: Tensor) -> Tensor:
            return (blur(values * m) / weight)[:, kept]

        mean_a, mean_b = mean(a), mean(b)
        var_a, var_b = mean(a * a) - mean_a**2, mean(b * b) - mean_b**2
        covariance = mean(a * b) - mean_a * mean_b
    luminance = (2 * mean_a * mean_b + C1) / (mean_a**2 + mean_b**2 + C1)
    return luminance * (2 * covariance + C2) / (var_a + var_b + C2)


def blur(planes: Tensor) -> Tensor:
    """Planes [C,H,W] under an 11x11 Gaussian window; what lies beyond the border is the border's value."""
    offsets = torch.arange(WINDOW, dtype=torch.float64) - WINDOW // 2
    window = torch.exp(-(offsets**2) / (2 * SIGMA**2))
    window = (window / window.sum()).to(planes)
    half = WINDOW // 2
    rows = pad(planes[:, None], (half, half, half, half), mode="replicate")
    return conv2d(conv2d(rows, window.view(1, 1, -1, 1)), window.view(1, 1, 1, -1))[:, 0]
