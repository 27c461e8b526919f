"""PSNR and SSIM in other codes' conventions, and the core's, against closed forms, scikit-image and torchmetrics."""

import importlib.util
import math

import numpy as np
import pytest
import torch
from sw_metrics.conventions import WINDOW, psnr_channel_mean, psnr_unrounded, ssim_reflect, ssim_valid
from sw_metrics.torchvision_import import import_torchvision

from splatwizard_core.errors import CapabilityError, ShapeError
from splatwizard_core.evaluation.image import prepare_render, psnr, ssim


def image(seed: int, height: int = 40, width: int = 52) -> torch.Tensor:
    """Smooth random picture in 0..1."""
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(1, 3, 6, 7, generator=generator)
    return torch.nn.functional.interpolate(coarse, (height, width), mode="bicubic", align_corners=False)[0].clamp(0, 1)


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
        x.double().numpy(), y.double().numpy(), data_range=1.0, channel_axis=0, gaussian_weights=True, sigma=1.5,
        use_sample_covariance=False, **options,
    )  # fmt: skip


def framed(x: torch.Tensor, mode: str) -> torch.Tensor:
    half = WINDOW // 2
    return torch.nn.functional.pad(x[None], [half] * 4, mode=mode)[0]


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


def test_the_mean_of_channels_is_a_tenth_of_a_decibel_above_for_the_ratios_of_the_protocol():
    truth = torch.zeros(3, 8, 8)
    mse = torch.tensor([1e-3, 1.3e-3, 1.7e-3])
    render = mse.sqrt()[:, None, None].expand(3, 8, 8)
    # The specification of the protocol works out 0.10 dB for these ratios.
    assert psnr_channel_mean(render, truth) - psnr(render, truth) == pytest.approx(0.10, abs=0.005)


def test_the_unrounded_psnr_is_that_of_the_core_bit_for_bit():
    x, y = pair(1)
    assert psnr_unrounded(x, y) == psnr(x, y)
    assert psnr_unrounded(x, x) == math.inf


@pytest.mark.parametrize("metric", [psnr_channel_mean, psnr_unrounded, ssim_valid, ssim_reflect])
@pytest.mark.parametrize("shape", [(3, 4), (1, 4, 4), (3, 4, 5)])
def test_wrong_shapes_are_refused(metric, shape):
    with pytest.raises(ShapeError, match=r"need two \[3,H,W\]"):
        metric(torch.zeros(shape), torch.zeros(3, 4, 4))
