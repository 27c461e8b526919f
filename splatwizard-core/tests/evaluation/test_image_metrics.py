"""PSNR, SSIM and L1 against closed forms, a direct evaluation of the definition, and scikit-image."""

import math

import numpy as np
import pytest
import torch

from splatwizard_core.errors import ShapeError
from splatwizard_core.evaluation.image import (
    SIGMA,
    WINDOW,
    l1,
    prepare_render,
    psnr,
    psnr_channel_mean,
    ssim,
    ssim_map,
)


def image(seed: int, height: int = 40, width: int = 52) -> torch.Tensor:
    """Smooth random picture in 0..1."""
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(1, 3, 6, 7, generator=generator)
    return torch.nn.functional.interpolate(coarse, (height, width), mode="bicubic", align_corners=False)[0].clamp(0, 1)


def test_psnr_of_a_constant_difference():
    truth = torch.full((3, 5, 7), 0.25)
    assert psnr(truth + 0.125, truth) == pytest.approx(-20 * math.log10(0.125), abs=1e-12)


def test_psnr_joins_the_channels_before_the_logarithm():
    truth = torch.zeros(3, 8, 8)
    render = torch.zeros(3, 8, 8)
    mse = (1e-3, 1.3e-3, 1.7e-3)
    for channel, value in enumerate(mse):
        render[channel] = math.sqrt(value)
    joint = -10 * math.log10(sum(mse) / 3)
    assert psnr(render, truth) == pytest.approx(joint, abs=1e-6)
    # The specification of the protocol works out 0.10 dB for these ratios.
    assert psnr_channel_mean(render, truth) - psnr(render, truth) == pytest.approx(0.10, abs=0.005)


def test_identical_images_have_infinite_psnr_and_ssim_one():
    picture = image(0)
    assert psnr(picture, picture) == math.inf
    assert ssim(picture, picture) == pytest.approx(1.0, abs=1e-6)
    assert l1(picture, picture) == 0.0


def test_l1_is_the_mean_absolute_error():
    truth = torch.zeros(3, 2, 2)
    render = truth.clone()
    render[0, 0, 0] = 0.6
    assert l1(render, truth) == pytest.approx(0.6 / 12)


def test_renders_are_clamped_and_rounded_to_8_bit():
    render = torch.tensor([-0.5, 0.0, 0.4999 / 255, 0.5001 / 255, 1.0, 3.0]).expand(3, 1, 6)
    assert (prepare_render(render)[0, 0] * 255).tolist() == pytest.approx([0, 0, 0, 1, 255, 255])
    assert prepare_render(render, quantize8=False)[0, 0].tolist() == pytest.approx(
        [0, 0, 0.4999 / 255, 0.5001 / 255, 1, 1]
    )


def test_rounding_to_8_bit_costs_what_the_protocol_says():
    generator = torch.Generator().manual_seed(3)
    render = torch.rand(3, 256, 256, generator=generator)
    mse = (prepare_render(render) - render).double().square().mean().item()
    assert mse == pytest.approx(1 / (12 * 255**2), rel=0.02)  # statistics of 200 k values


def direct_ssim(x: np.ndarray, y: np.ndarray) -> float:
    """The definition, pixel by pixel, float64, zero padding."""
    half = WINDOW // 2
    axis = np.exp(-((np.arange(WINDOW) - half) ** 2) / (2 * SIGMA**2))
    axis /= axis.sum()
    window = np.outer(axis, axis)
    x, y = (np.pad(a, ((0, 0), (half, half), (half, half))) for a in (x, y))
    values = []
    for c in range(x.shape[0]):
        for i in range(x.shape[1] - 2 * half):
            for j in range(x.shape[2] - 2 * half):
                a = x[c, i : i + WINDOW, j : j + WINDOW]
                b = y[c, i : i + WINDOW, j : j + WINDOW]
                ma, mb = (window * a).sum(), (window * b).sum()
                va, vb = (window * a * a).sum() - ma**2, (window * b * b).sum() - mb**2
                cov = (window * a * b).sum() - ma * mb
                values.append((2 * ma * mb + 1e-4) * (2 * cov + 9e-4) / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4)))
    return float(np.mean(values))


def test_ssim_equals_a_direct_evaluation_of_the_definition():
    x, y = image(1, 16, 16), (image(1, 16, 16) + 0.1 * image(2, 16, 16)).clamp(0, 1)
    expected = direct_ssim(x.double().numpy(), y.double().numpy())
    assert ssim(x, y) == pytest.approx(expected, abs=2e-6)  # float32 moments


def test_ssim_equals_scikit_image_away_from_the_border():
    metrics = pytest.importorskip("skimage.metrics", reason="scikit-image is an independent implementation")
    x, y = image(3).double(), (image(3) + 0.2 * (image(4) - 0.5)).clamp(0, 1).double()
    _, theirs = metrics.structural_similarity(
        x.numpy(), y.numpy(), data_range=1.0, channel_axis=0, gaussian_weights=True, sigma=SIGMA,
        use_sample_covariance=False, full=True,
    )  # fmt: skip
    inside = (slice(None), slice(5, -5), slice(5, -5))  # it mirrors at the border, the 3DGS codes pad with zeros
    np.testing.assert_allclose(ssim_map(x, y).numpy()[inside], theirs[inside], atol=1e-9)


@pytest.mark.parametrize("metric", [psnr, ssim, l1, psnr_channel_mean])
@pytest.mark.parametrize("shape", [(3, 4), (1, 4, 4), (3, 4, 5)])
def test_wrong_shapes_are_refused(metric, shape):
    with pytest.raises(ShapeError, match=r"need two \[3,H,W\]"):
        metric(torch.zeros(shape), torch.zeros(3, 4, 4))
