"""Metrics of a render whose colours were first fitted to the photograph: what is left once exposure cannot be blamed.

The correction is fitted on the test photograph itself, so the values are diagnostics, beside the plain ones, in no
rate-distortion table. Even pure noise gains by it (shrinkage), so below 1 dB a gain says nothing about exposure.
Source: specification of the protocols, exposure. The quadratic one is that of multinerf (arXiv 2111.12077).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from splatwizard_core.api import MetricSetup, PreparedMetric, psnr, ssim_map
from sw_metrics.conventions import check_pair, psnr_of
from sw_metrics.perceptual import VGG_3DGS, Lpips

SMALLEST_EIGENVALUE = 1e-10  # of the largest; smaller ones count as 0, so grey and constant renders are fitted too
ROUNDING = 1e-15  # of a variance, which comes from sums over the pixels
PIECE = 1 << 16  # pixels
FLATTEST = 1e-12  # variance of a channel, below which it has no slope
ROUNDS, CLIPPED = 5, 0.5 / 255  # of the quadratic correction; how near to 0 or 1 a value is taken for clipped
FEWEST = 10  # usable pixels of a channel: as many as the quadratic correction has coefficients


def affine(render: Tensor, truth: Tensor) -> Tensor:
    """The render [3,H,W], every colour x replaced by clip(x A + b), with A [3,3] and b [3] of the least squares."""
    check_pair(render, truth)
    if torch.equal(render, truth):  # rounding would make them differ
        return render.double()
    A, b = fitted(render, truth)
    return torch.addmm(b[:, None], A.T, render.double().flatten(1)).reshape(render.shape).clamp(0, 1)


def fitted(render: Tensor, truth: Tensor) -> tuple[Tensor, Tensor]:
    """A [3,3] and b [3], float64, that minimise |x A + b - y|; the smallest A of those that do."""
    sums = torch.zeros(7, 7, dtype=torch.float64, device=render.device)  # of products of (x, y, 1)
    for x, y in pieces(render, truth):
        values = torch.cat([x, y, torch.ones_like(x[:1])])
        sums += values @ values.T
    mean = sums[6, :6] / sums[6, 6]
    moments = sums[:6, :6] / sums[6, 6] - torch.outer(mean, mean)
    A = solved(moments[:3, :3], moments[:3, 3:])
    return A, mean[3:] - mean[:3] @ A


def pieces(render: Tensor, truth: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """Pixels [3,n] of both in float64, few enough for a processor's cache: five times as fast as all at once."""
    for x, y in zip(*(torch.split(image.flatten(1), PIECE, 1) for image in (render, truth)), strict=True):
        yield x.double(), y.double()


def by_channel(render: Tensor, truth: Tensor) -> Tensor:
    """The render [3,H,W], each channel scaled and shifted by its own least squares."""
    check_pair(render, truth)
    x, y = (image.double().flatten(1) for image in (render, truth))  # [3,n]
    mean_x, mean_y = x.mean(dim=1, keepdim=True), y.mean(dim=1, keepdim=True)
    variance = (x - mean_x).square().mean(dim=1, keepdim=True)
    slope = ((x - mean_x) * (y - mean_y)).mean(dim=1, keepdim=True) / variance.clamp(min=FLATTEST)
    slope = torch.where(variance < FLATTEST, torch.zeros_like(slope), slope)
    return (slope * (x - mean_x) + mean_y).reshape(render.shape).clamp(0, 1)


def quadratic(render: Tensor, truth: Tensor) -> Tensor:
    """The render [3,H,W] after five rounds of a quadratic fit for each channel, over pixels that are not clipped.

    A channel in which fewer than 10 pixels are usable stays as it is.
    """
    check_pair(render, truth)
    x, y = (image.double().flatten(1) for image in (render, truth))  # [3,n]
    free = usable(x) & usable(y)
    for _ in range(ROUNDS):
        r, g, b = x
        features = torch.stack([r * r, r * g, r * b, g * g, g * b, b * b, r, g, b, torch.ones_like(r)])  # [10,n]
        fitted = []
        for channel in range(3):
            used = free[channel] & usable(x[channel])
            if int(used.sum()) < FEWEST:
                fitted.append(x[channel])
                continue
            chosen = features * used  # faster than to pick the pixels
            gram, moments = (chosen @ features.T).cpu(), (chosen @ y[channel, :, None]).cpu()
            weights = torch.linalg.lstsq(gram, moments, driver="gelsd", rcond=1e-15).solution
            fitted.append(weights[:, 0].to(features) @ features)
        x = torch.stack(fitted).clamp(0, 1)
    return x.reshape(render.shape)


def usable(values: Tensor) -> Tensor:
    """Whether values in 0..1 are not clipped."""
    return (values >= CLIPPED) & (values <= 1 - CLIPPED)


def solved(gram: Tensor, moments: Tensor) -> Tensor:
    """The smallest W [k,m] of those that minimise |A W - B|, of A^T A / n [k,k] and A^T B / n [k,m]."""
    values, vectors = torch.linalg.eigh(gram)
    kept = values > (SMALLEST_EIGENVALUE * values[-1]).clamp(min=ROUNDING)
    inverse = torch.where(kept, 1 / torch.where(kept, values, torch.ones_like(values)), torch.zeros_like(values))
    found: Tensor = vectors @ (inverse[:, None] * (vectors.T @ moments))
    return found


def cc_psnr(render: Tensor, truth: Tensor) -> float:
    """PSNR in dB, joint over channels, of the affinely corrected render, which is not rounded again."""
    check_pair(render, truth)
    if not truth.numel():  # nothing is inside a mask
        return math.nan
    if torch.equal(render, truth):
        return math.inf
    A, b = fitted(render, truth)
    squares = torch.zeros((), dtype=torch.float64, device=render.device)
    for x, y in pieces(render, truth):
        squares += torch.addmm(b[:, None], A.T, x).clamp_(0, 1).sub_(y).square_().sum()
    return psnr_of(squares.item() / truth.numel())


def cc_gain(render: Tensor, truth: Tensor) -> float:
    """Gain of the correction, `cc_psnr` - `psnr`, dB; 0 for equal images."""
    corrected, plain = cc_psnr(render, truth), psnr(render, truth)
    return 0.0 if corrected == plain else corrected - plain


def cc_psnr_channel(render: Tensor, truth: Tensor) -> float:
    """PSNR in dB after a slope and an offset for each channel."""
    return psnr(by_channel(render, truth), truth.double())


def cc_psnr_quad(render: Tensor, truth: Tensor) -> float:
    """PSNR in dB after multinerf's quadratic correction."""
    return psnr(quadratic(render, truth), truth.double())


def cc_ssim(render: Tensor, truth: Tensor) -> float:
    """SSIM of the 3DGS code of the affinely corrected render."""
    return float(ssim_map(affine(render, truth).float(), truth.float()).double().mean())


@dataclass(frozen=True)
class Corrected:
    """A form of LPIPS of the affinely corrected render."""

    form: Lpips

    def prepare(self, setup: MetricSetup) -> PreparedMetric:
        """The metric on the setup's device. Raises what the form itself raises."""
        ready = self.form.prepare(setup)

        def compute(render: Tensor, truth: Tensor) -> float:
            return ready.compute(affine(render, truth).to(truth), truth)

        return PreparedMetric(compute, ready.made_with, ready.verified)

    def identity(self, setup: MetricSetup) -> str | None:
        """That of the form itself."""
        return self.form.identity(setup)


CC_VGG_3DGS = Corrected(VGG_3DGS)
