"""PSNR, SSIM and L1 against closed forms, a direct evaluation of the definition, scikit-image and torchmetrics."""

import importlib.util
import math

import numpy as np
import pytest
import torch
from sw_metrics.torchvision_import import import_torchvision

from splatwizard_core.errors import CapabilityError, ShapeError
from splatwizard_core.evaluation.image import (
    SIGMA,
    WINDOW,
    l1,
    prepare_render,
    psnr,
    psnr_channel_mean,
    ssim,
    ssim_map,
    ssim_reflect,
    ssim_valid,
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


@pytest.fixture(scope="module")
def torchmetrics():
    """torchmetrics' image functions; it imports torchvision where that is installed."""
    if importlib.util.find_spec("torchmetrics") is None:
        pytest.skip("torchmetrics is an independent implementation")
    if importlib.util.find_spec("torchvision") is not None:
        import_torchvision()
    import torchmetrics.functional.image as module

    return module


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


@pytest.mark.parametrize("seed", range(4))
def test_psnr_equals_both_libraries_in_both_conventions(skimage, torchmetrics, seed: int):
    x, y = pair(seed)
    theirs = skimage.peak_signal_noise_ratio(y.double().numpy(), x.double().numpy(), data_range=1.0)
    assert psnr(x, y) == pytest.approx(theirs, abs=1e-9)
    by_torchmetrics = torchmetrics.peak_signal_noise_ratio(x[None], y[None], data_range=1.0)
    assert psnr(x, y) == pytest.approx(float(by_torchmetrics), abs=2e-5)  # it sums in float32
    channels = [
        skimage.peak_signal_noise_ratio(b.double().numpy(), a.double().numpy(), data_range=1.0)
        for a, b in zip(x, y, strict=True)
    ]
    assert psnr_channel_mean(x, y) == pytest.approx(np.mean(channels), abs=1e-9)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    ("ours", "frame"), [(ssim, "constant"), (ssim_valid, None), (ssim_reflect, "reflect")],
    ids=["zeros", "valid", "reflect"],
)  # fmt: skip
def test_ssim_equals_both_libraries_at_each_kind_of_border(skimage, torchmetrics, ours, frame: str | None, seed: int):
    x, y = pair(seed)
    # Neither library pads with zeros. A frame of half a window, whose pixels are not averaged, is the padding.
    a, b = (x, y) if frame is None else (framed(x, frame), framed(y, frame))
    assert ours(x, y) == pytest.approx(scikit_ssim(skimage, a, b), abs=2e-6)  # our moments are float32
    _, full = torchmetrics.structural_similarity_index_measure(
        a[None].double(), b[None].double(), data_range=1.0, return_full_image=True
    )
    assert ours(x, y) == pytest.approx(float(full[..., 5:-5, 5:-5].mean()), abs=2e-6)


def test_the_value_that_torchmetrics_prints_is_that_of_the_mirrored_border(torchmetrics):
    x, y = pair(0)
    printed = float(torchmetrics.structural_similarity_index_measure(x[None], y[None], data_range=1.0))
    assert ssim_reflect(x, y) == pytest.approx(printed, abs=1e-5)
    assert abs(ssim(x, y) - printed) > 1e-3  # so it must not be compared with the 3DGS value


def test_the_border_conventions_differ_by_the_border_alone():
    # Constant pictures: inside, every window has the same moments.
    x, y = torch.full((3, 40, 50), 0.5), torch.full((3, 40, 50), 0.7)
    inside = (2 * 0.5 * 0.7 + 1e-4) / (0.5**2 + 0.7**2 + 1e-4)
    # float32 cancels in the variance of a constant: 1e-7 against C2 = 9e-4
    assert ssim_valid(x, y) == pytest.approx(inside, abs=1e-3)
    assert ssim_reflect(x, y) == pytest.approx(ssim_valid(x, y), abs=1e-6)
    assert ssim(x, y) != pytest.approx(inside, abs=1e-3)


def test_pictures_smaller_than_a_window_have_no_value_without_padding():
    small = torch.zeros(3, 10, 40)
    for metric in (ssim_valid, ssim_reflect):
        with pytest.raises(CapabilityError, match="too-small: no window of 11x11"):
            metric(small, small)
    assert ssim(small, small) == 1.0


@pytest.mark.parametrize("seed", range(6))
def test_the_mean_of_channel_psnrs_is_never_below_the_joint_one(seed: int):
    x, y = pair(seed)
    assert psnr_channel_mean(x, y) >= psnr(x, y)


def test_one_identical_channel_makes_the_mean_of_channel_psnrs_infinite_and_leaves_the_joint_one():
    truth = torch.full((3, 4, 4), 0.5)
    render = truth.clone()
    render[0] += 0.25
    assert psnr_channel_mean(render, truth) == math.inf
    assert psnr(render, truth) == pytest.approx(-10 * math.log10(0.25**2 / 3), abs=1e-9)


def test_rounding_lowers_psnr_by_what_its_error_adds():
    generator = torch.Generator().manual_seed(5)
    truth = prepare_render(torch.rand(3, 200, 200, generator=generator) * 0.5 + 0.25)
    for decibel, expected in ((27, 0.003), (35, 0.018)):
        render = truth + 10 ** (-decibel / 20) * torch.randn(truth.shape, generator=generator)
        loss = psnr(render, truth) - psnr(prepare_render(render), truth)
        assert loss == pytest.approx(expected, abs=1.5e-3)  # the protocol's own figures; statistics of 120 k values


@pytest.mark.parametrize("metric", [psnr, ssim, l1, psnr_channel_mean, ssim_valid, ssim_reflect])
@pytest.mark.parametrize("shape", [(3, 4), (1, 4, 4), (3, 4, 5)])
def test_wrong_shapes_are_refused(metric, shape):
    with pytest.raises(ShapeError, match=r"need two \[3,H,W\]"):
        metric(torch.zeros(shape), torch.zeros(3, 4, 4))
