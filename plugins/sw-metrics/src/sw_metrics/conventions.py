"""PSNR and SSIM as other codes compute them: diagnostics, to tell how much of a difference is convention.

Each takes (render, truth), both [3,H,W] floating point in 0..1, and returns a float.
Source: specification of the evaluation protocol, image metrics.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import pad

from splatwizard_core.api import CapabilityError, ShapeError, ssim_map

WINDOW = 11  # pixels: the width of SSIM's window


def check_pair(render: Tensor, truth: Tensor) -> None:
    """Raise ShapeError unless both are [3,H,W] of one size."""
    if render.dim() != 3 or render.shape[0] != 3 or render.shape != truth.shape:
        raise ShapeError(f"image metrics need two [3,H,W] images, got {list(render.shape)} and {list(truth.shape)}")


def psnr_of(mse: float) -> float:
    """PSNR in dB of a mean squared error of values in 0..1; infinite for 0."""
    return math.inf if mse == 0 else -10 * math.log10(mse)


def psnr_unrounded(render: Tensor, truth: Tensor) -> float:
    """Peak signal-to-noise ratio in dB, joint over channels; its entry asks for renders that are not rounded to 8 bit.

    Identical images give infinity.
    """
    check_pair(render, truth)
    return psnr_of((render.double() - truth.double()).square().mean().item())


def psnr_channel_mean(render: Tensor, truth: Tensor) -> float:
    """Mean of the three channels' PSNRs, dB: never below the joint one (Jensen). Some codes print it.

    Infinite as soon as one channel is identical.
    """
    check_pair(render, truth)
    mse = (render.double() - truth.double()).square().mean(dim=(1, 2))  # [3]
    return float((-10 * torch.log10(mse)).mean())


def ssim_valid(render: Tensor, truth: Tensor) -> float:
    """SSIM of the 3DGS code, averaged over the pixels whose window lies in the picture (5 pixels from each edge).

    This is what scikit-image averages. Raises CapabilityError if no window fits.
    """
    check_pair(render, truth)
    _check_window(render)
    half = WINDOW // 2
    return float(ssim_map(render.float(), truth.float())[:, half:-half, half:-half].double().mean())


def ssim_reflect(render: Tensor, truth: Tensor) -> float:
    """SSIM of the 3DGS code on a picture that is mirrored at its edge (the edge itself is not repeated).

    This is what torchmetrics 1.9 averages, and so the codes that use it (gsplat). Raises CapabilityError if no
    window fits.
    """
    check_pair(render, truth)
    _check_window(render)
    half = WINDOW // 2
    x, y = (pad(image.float()[None], [half] * 4, mode="reflect")[0] for image in (render, truth))
    return float(ssim_map(x, y)[:, half:-half, half:-half].double().mean())


def _check_window(image: Tensor) -> None:
    if min(image.shape[1:]) < WINDOW:
        raise CapabilityError(f"too-small: no window of {WINDOW}x{WINDOW} pixels fits into {list(image.shape)}")
