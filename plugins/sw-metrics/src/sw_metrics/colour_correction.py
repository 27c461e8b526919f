"""Metrics of a render whose colours were first fitted to the photograph: what is left once exposure cannot be blamed.

The correction is fitted on the test photograph itself, so the values are diagnostics, beside the plain ones, in no
rate-distortion table. Even pure noise gains by it (shrinkage), so below 1 dB a gain says nothing about exposure.
Source: specification of the protocols, exposure. The quadratic one is that of multinerf (arXiv 2111.12077).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from splatwizard_core.api import MetricSetup, PreparedMetric, psnr, ssim_map
from sw_metrics.conventions import check_pair
from sw_metrics.perceptual import VGG_3DGS, Lpips

SMALLEST_EIGENVALUE = 1e-10  # of the largest; smaller ones count as 0, so grey and constant renders are fitted too
FLATTEST = 1e-12  # variance of a channel, below which it has no slope
ROUNDS, CLIPPED = 5, 0.5 / 255  # of the quadratic correction; how near to 0 or 1 a value is taken for clipped
FEWEST = 10  # usable pixels of a channel: as many as the quadratic correction has coefficients


def affine(render: Tensor, truth: Tensor) -> Tensor:
    """The render [3,H,W], every colour x replaced by clip(x A + b), with A [3,3] and b [3] of the least squares."""
    check_pair(render, truth)
    if torch.equal(render, truth):  # rounding would make them differ
        return render.double()
    x, y = (image.double().flatten(1).T for image in (render, truth))  # [n,3]
    centred = x - x.mean(dim=0)
    weights = solved(centred, y - y.mean(dim=0))
    return (centred @ weights + y.mean(dim=0)).T.reshape(render.shape).clamp(0, 1)


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


def solved(a: Tensor, b: Tensor) -> Tensor:
    """The smallest W [k,m] of those that minimise |A W - B|, of A [n,k] and B [n,m]."""
    values, vectors = torch.linalg.eigh(a.T @ a)
    kept = values > SMALLEST_EIGENVALUE * values[-1].clamp(min=0)
    inverse = torch.where(kept, 1 / torch.where(kept, values, torch.ones_like(values)), torch.zeros_like(values))
    return vectors @ (inverse[:, None] * (vectors.T @ (a.T @ b)))


def cc_psnr(render: Tensor, truth: Tensor) -> float:
    """PSNR in dB, joint over channels, of the affinely corrected render, which is not rounded again."""
    return psnr(affine(render, truth), truth.double())


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
