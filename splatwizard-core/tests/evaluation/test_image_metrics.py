"""PSNR, SSIM and L1 against closed forms, a direct evaluation of the definition, and scikit-image."""

import math

import numpy as np
import pytest
import torch

from splatwizard_core.errors import ShapeError
from splatwizard_core.evaluation.image import l1, prepare_render, psnr, ssim
from splatwizard_native import ssim_map

WINDOW, SIGMA = 11, 1.5  # pixels


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


@pytest.fixture(scope="module")
def skimage():
    return pytest.importorskip("skimage.metrics", reason="scikit-image is an independent implementation")


def pair(seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """A picture and a worse one, both in 8 bit."""
    truth = image(seed)
    generator = torch.Generator().manual_seed(seed + 100)
    noisy = truth + 0.08 * torch.randn(truth.shape, generator=generator) + 0.03 * (image(seed + 50) - 0.5)
    return prepare_render(noisy), prepare_render(truth)


def scikit_ssim(skimage, x: torch.Tensor, y: torch.Tensor, **options) -> object:
    return skimage.structural_similarity(
        x.double().numpy(), y.double().numpy(), data_range=1.0, channel_axis=0, gaussian_weights=True, sigma=SIGMA,
        use_sample_covariance=False, **options,
    )  # fmt: skip


def framed(x: torch.Tensor, mode: str) -> torch.Tensor:
    half = WINDOW // 2
    return torch.nn.functional.pad(x[None], [half] * 4, mode=mode)[0]


def test_the_ssim_map_equals_scikit_images_away_from_the_border(skimage):
    x, y = (picture.double() for picture in pair(3))
    _, theirs = scikit_ssim(skimage, x, y, full=True)
    inside = (slice(None), slice(5, -5), slice(5, -5))  # it mirrors at the border, the 3DGS codes pad with zeros
    np.testing.assert_allclose(ssim_map(x, y).numpy()[inside], theirs[inside], atol=1e-9)


def test_rounding_lowers_psnr_by_what_its_error_adds():
    generator = torch.Generator().manual_seed(5)
    truth = prepare_render(torch.rand(3, 200, 200, generator=generator) * 0.5 + 0.25)
    for decibel, expected in ((27, 0.003), (35, 0.018)):
        render = truth + 10 ** (-decibel / 20) * torch.randn(truth.shape, generator=generator)
        loss = psnr(render, truth) - psnr(prepare_render(render), truth)
        assert loss == pytest.approx(expected, abs=1.5e-3)  # the protocol's own figures; statistics of 120 k values


@pytest.mark.parametrize("metric", [psnr, ssim, l1])
@pytest.mark.parametrize("shape", [(3, 4), (1, 4, 4), (3, 4, 5)])
def test_wrong_shapes_are_refused(metric, shape):
    with pytest.raises(ShapeError, match=r"need two \[3,H,W\]"):
        metric(torch.zeros(shape), torch.zeros(3, 4, 4))


@pytest.mark.parametrize("seed", range(4))
def test_psnr_equals_that_of_scikit_image(skimage, seed: int):
    x, y = pair(seed)
    theirs = skimage.peak_signal_noise_ratio(y.double().numpy(), x.double().numpy(), data_range=1.0)
    assert psnr(x, y) == pytest.approx(theirs, abs=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_ssim_equals_that_of_scikit_image_with_a_frame_of_zeros(skimage, seed: int):
    x, y = pair(seed)
    # It does not pad with zeros. A frame of half a window, whose pixels are not averaged, is the padding.
    assert ssim(x, y) == pytest.approx(scikit_ssim(skimage, framed(x, "constant"), framed(y, "constant")), abs=2e-6)


def test_no_picture_is_too_small_for_ssim():
    small = torch.zeros(3, 10, 40)
    assert ssim(small, small) == 1.0
