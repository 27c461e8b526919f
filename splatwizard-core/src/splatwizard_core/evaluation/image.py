"""Image metrics: PSNR, SSIM and L1 of a render against a photograph, as the 3DGS code computes them.

Every metric takes (render, truth), both [3,H,W] floating point in 0..1, and returns a float. Renders are clamped
(and, by protocol, rounded to 8 bit) before they come here: `prepare_render`.
Source: specification of the evaluation protocol, image metrics; training pipeline, loss.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from splatwizard_core.errors import ShapeError
from splatwizard_native import ssim_map


def _check(render: Tensor, truth: Tensor) -> None:
    if render.dim() != 3 or render.shape[0] != 3 or render.shape != truth.shape:
        raise ShapeError(f"image metrics need two [3,H,W] images, got {list(render.shape)} and {list(truth.shape)}")


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
