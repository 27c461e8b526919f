"""Image metrics: PSNR, SSIM and L1 of a render against a photograph, as the 3DGS code computes them.

Every metric takes (render, truth), both [3,H,W] floating point in 0..1, and returns a float. Renders are clamped
(and, by protocol, rounded to 8 bit) before they come here: `prepare_render`.
Source: specification of the evaluation protocol, image metrics; training pipeline, loss.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import conv2d

from splatwizard_core.errors import ShapeError

WINDOW = 11  # pixels
SIGMA = 1.5  # pixels
C1, C2 = 0.01**2, 0.03**2  # for a data range of 1


def _check(render: Tensor, truth: Tensor) -> None:
    if render.dim() != 3 or render.shape[0] != 3 or render.shape != truth.shape:
        raise ShapeError(
            f"image metrics need two [3,H,W] images, got {list(render.shape)} and {list(truth.shape)}",
            actual=render.shape,
            expected=(3, "H", "W"),
        )


def prepare_render(image: Tensor, *, quantize8: bool = True) -> Tensor:
    """Clamp to 0..1 and, by protocol, round to 8 bit as a saved PNG would: round(255 x) / 255.

    image   [3,H,W]; returns the same shape and dtype
    """
    image = image.clamp(0, 1)
    return torch.round(image * 255) / 255 if quantize8 else image


def psnr(render: Tensor, truth: Tensor) -> float:
    """Peak signal-to-noise ratio in dB, -10 log10 of the mean squared error over all 3*H*W values, in float64.

    Identical images give infinity.
    """
    _check(render, truth)
    mse = (render.double() - truth.double()).square().mean().item()
    return math.inf if mse == 0 else -10 * math.log10(mse)


def l1(render: Tensor, truth: Tensor) -> float:
    """Mean absolute error over all 3*H*W values, in float64."""
    _check(render, truth)
    return float((render.double() - truth.double()).abs().mean())


def ssim(render: Tensor, truth: Tensor) -> float:
    """Structural similarity in -1..1: 11x11 Gaussian window, sigma 1.5, zero padding, mean over channels and pixels.

    Moments are E[xy] - E[x]E[y] with the same window, in float32; the mean is taken in float64.
    """
    _check(render, truth)
    return float(ssim_map(render.float(), truth.float()).double().mean())


def ssim_map(x: Tensor, y: Tensor) -> Tensor:
    """The structural similarity at each pixel, [C,H,W] -> [C,H,W]; pads with zeros, keeps the dtype."""
    offsets = torch.arange(WINDOW, dtype=torch.float64) - WINDOW // 2
    window = torch.exp(-(offsets**2) / (2 * SIGMA**2))
    window = (window / window.sum()).to(x)  # [11]

    def blur(image: Tensor) -> Tensor:
        rows = image[:, None]  # [C,1,H,W]
        rows = conv2d(rows, window.view(1, 1, -1, 1), padding=(WINDOW // 2, 0))
        return conv2d(rows, window.view(1, 1, 1, -1), padding=(0, WINDOW // 2))[:, 0]

    mean_x, mean_y = blur(x), blur(y)
    var_x, var_y = blur(x * x) - mean_x**2, blur(y * y) - mean_y**2
    covariance = blur(x * y) - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + C1) / (mean_x**2 + mean_y**2 + C1)
    structure = (2 * covariance + C2) / (var_x + var_y + C2)
    return luminance * structure
