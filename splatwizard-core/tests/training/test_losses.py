"""SSIM and the photometric loss: the definition in float64, an independent library, and the compiled kernel."""

import math
import time
from types import SimpleNamespace
from typing import Literal

import numpy as np
import pytest
import torch

from splatwizard_core.errors import ShapeError
from splatwizard_core.training.losses import photometric_loss
from splatwizard_native.fused import photometric
from splatwizard_native.fused.native import TRAINING

SIZES = [(1, 1), (1, 40), (40, 1), (5, 300), (17, 33), (64, 129), (11, 256)]


@pytest.fixture(scope="module")
def kernels() -> None:
    """The compiled kernels; they are compiled once and then found in the cache."""
    if not TRAINING.try_load():
        pytest.skip(f"no compiled kernels: {TRAINING.available()}")


@pytest.fixture
def torch_path(monkeypatch) -> None:
    monkeypatch.setattr(photometric, "TRAINING", SimpleNamespace(try_load=lambda: False))


def images(height: int, width: int, dtype=torch.float32, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    x = torch.rand(3, height, width, generator=generator, dtype=torch.float64)
    y = (x + 0.2 * torch.randn(3, height, width, generator=generator, dtype=torch.float64)).clamp(0, 1)
    return x.to(dtype), y.to(dtype)


def ssim(x: torch.Tensor, y: torch.Tensor, *, padding: Literal["same", "valid"] = "same") -> torch.Tensor:
    """SSIM alone: the loss without its L1 part."""
    return 1 - photometric_loss(x, y, lambda_dssim=1.0, padding=padding).total


def ssim_by_definition(x: np.ndarray, y: np.ndarray, *, valid: bool) -> float:
    """Window by window with all 121 weights, float64."""
    offsets = np.arange(-5, 6)
    window = np.exp(-(offsets[:, None] ** 2 + offsets[None] ** 2) / (2 * 1.5**2))
    window /= window.sum()
    values = []
    for a, b in zip(x, y, strict=True):
        border = 0 if valid else 5
        a, b = np.pad(a, border), np.pad(b, border)
        for i in range(a.shape[0] - 10):
            for j in range(a.shape[1] - 10):
                p, q = a[i : i + 11, j : j + 11], b[i : i + 11, j : j + 11]
                mp, mq = (window * p).sum(), (window * q).sum()
                vp, vq = (window * p * p).sum() - mp**2, (window * q * q).sum() - mq**2
                cov = (window * p * q).sum() - mp * mq
                values.append((2 * mp * mq + 1e-4) * (2 * cov + 9e-4) / ((mp**2 + mq**2 + 1e-4) * (vp + vq + 9e-4)))
    return float(np.mean(values))


def value_and_gradient(x, y, **options):
    x = x.clone().requires_grad_()
    value = ssim(x, y, **options)
    value.backward()
    assert x.grad is not None
    return value.item(), x.grad


@pytest.mark.parametrize("padding", ["same", "valid"])
def test_ssim_is_the_definition(padding):
    x, y = images(16, 16, torch.float64)
    expected = ssim_by_definition(x.numpy(), y.numpy(), valid=padding == "valid")
    assert ssim(x, y, padding=padding).item() == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("padding", ["same", "valid"])
def test_the_compiled_ssim_is_the_definition(kernels, padding):
    x, y = images(16, 16)
    expected = ssim_by_definition(x.double().numpy(), y.double().numpy(), valid=padding == "valid")
    assert ssim(x, y, padding=padding).item() == pytest.approx(expected, abs=1e-6)


def test_valid_ssim_is_that_of_scikit_image():
    metrics = pytest.importorskip("skimage.metrics")
    x, y = images(40, 52, torch.float64)
    _, similarity = metrics.structural_similarity(
        x.numpy(), y.numpy(), channel_axis=0, data_range=1.0, gaussian_weights=True, sigma=1.5,
        use_sample_covariance=False, full=True,
    )  # fmt: skip
    assert ssim(x, y, padding="valid").item() == pytest.approx(similarity[:, 5:-5, 5:-5].mean(), abs=1e-12)


@pytest.mark.parametrize("padding", ["same", "valid"])
def test_the_gradient_of_the_torch_ssim_is_its_derivative(padding):
    x, y = images(13, 12, torch.float64)
    assert torch.autograd.gradcheck(
        lambda a, b: ssim(a, b, padding=padding), (x[:1].requires_grad_(), y[:1].requires_grad_())
    )


@pytest.mark.parametrize(
    ("size", "padding"), [(s, p) for s in SIZES for p in ("same", "valid") if p == "same" or min(s) >= 11]
)
def test_compiled_and_torch_ssim_agree(kernels, size, padding):
    x, y = images(*size)
    value, gradient = value_and_gradient(x, y, padding=padding)
    expected, expected_gradient = value_and_gradient(x.double(), y.double(), padding=padding)
    assert value == pytest.approx(expected, abs=1e-6)
    assert (gradient - expected_gradient).norm() <= 2e-6 * expected_gradient.norm()


def test_the_torch_path_in_float32_agrees_with_float64(torch_path):
    x, y = images(17, 33)
    value, gradient = value_and_gradient(x, y)
    expected, expected_gradient = value_and_gradient(x.double(), y.double())
    assert value == pytest.approx(expected, abs=1e-5)
    assert (gradient - expected_gradient).norm() <= 1e-4 * expected_gradient.norm()


@pytest.mark.parametrize("level", [0.0, 0.5, 1.0])
def test_flat_images_agree_too(kernels, level):
    # No variance: what is left of E[x^2] - E[x]^2 is float32 rounding, up to 2.25 * 1e-7 beside C2 = 9e-4.
    x, y = torch.full((3, 20, 30), level), torch.full((3, 20, 30), 0.5)
    value, gradient = value_and_gradient(x, y)
    expected, expected_gradient = value_and_gradient(x.double(), y.double())
    assert value == pytest.approx(expected, abs=1e-5)
    assert (gradient - expected_gradient).norm() <= 5e-4 * expected_gradient.norm() + 1e-8


def test_an_image_is_perfectly_similar_to_itself(kernels):
    x, _ = images(33, 65)
    value, gradient = value_and_gradient(x, x)
    assert value == pytest.approx(1.0, abs=1e-7)
    assert gradient.abs().max() < 1e-7


def test_the_result_is_the_same_for_any_number_of_threads(kernels):
    x, y = images(150, 130)
    before = torch.get_num_threads()
    results = []
    try:
        for threads in (1, 2, 3, 5):
            torch.set_num_threads(threads)
            results.append(value_and_gradient(x, y))
    finally:
        torch.set_num_threads(before)
    for value, gradient in results[1:]:
        assert value == results[0][0]
        assert torch.equal(gradient, results[0][1])


def loss_by_hand(x, y, lambda_dssim):
    return (1 - lambda_dssim) * (x - y).abs().mean() + lambda_dssim * (1 - ssim(x, y))


@pytest.mark.parametrize("lambda_dssim", [0.0, 0.2, 1.0])
@pytest.mark.parametrize("path", ["kernels", "torch_path"])
def test_the_loss_mixes_l1_and_ssim(request, path, lambda_dssim):
    request.getfixturevalue(path)
    x, y = images(17, 33)
    x[0, 3, 4] = y[0, 3, 4]  # the gradient of |0| is 0
    xd = x.double().requires_grad_()
    expected = loss_by_hand(xd, y.double(), lambda_dssim)
    expected.backward()
    x.requires_grad_()
    pack = photometric_loss(x, y, lambda_dssim=lambda_dssim)
    pack.total.backward()
    assert pack.total.item() == pytest.approx(expected.item(), abs=1e-6)
    assert (x.grad - xd.grad).norm() <= 1e-5 * xd.grad.norm()
    assert set(pack.parts) == {"l1", "ssim"}
    assert pack.parts["l1"].item() == pytest.approx((x - y).abs().mean().item(), abs=1e-6)
    assert pack.parts["ssim"].item() == pytest.approx(ssim(x, y).item(), abs=1e-6)
    assert not any(part.requires_grad for part in pack.parts.values())


@pytest.mark.parametrize("path", ["kernels", "torch_path"])
def test_without_padding_the_loss_takes_the_ssim_of_the_inner_windows(request, path):
    request.getfixturevalue(path)
    x, y = images(17, 33)
    x.requires_grad_()
    pack = photometric_loss(x, y, padding="valid")
    pack.total.backward()
    inner = ssim_by_definition(x.detach().double().numpy(), y.double().numpy(), valid=True)
    assert pack.parts["ssim"].item() == pytest.approx(inner, abs=1e-6)
    assert pack.total.item() == pytest.approx(0.8 * (x - y).abs().mean().item() + 0.2 * (1 - inner), abs=1e-6)
    wanted = x.detach().double().requires_grad_()
    (0.8 * (wanted - y.double()).abs().mean() + 0.2 * (1 - ssim(wanted, y.double(), padding="valid"))).backward()
    assert (x.grad - wanted.grad).norm() <= 1e-5 * wanted.grad.norm()


def test_a_scaled_loss_has_a_scaled_gradient(kernels):
    x, y = images(17, 33)
    _, once = value_and_gradient(x, y)
    x.requires_grad_()
    (3 * ssim(x, y)).backward()
    torch.testing.assert_close(x.grad, 3 * once)


def test_clamping_stops_the_gradient_outside_the_range(kernels):
    x, y = images(17, 33)
    x = (2 * x - 0.5).requires_grad_()
    photometric_loss(x, y, clamp=True).total.backward()
    outside = (x < 0) | (x > 1)
    assert 0.2 < outside.float().mean() < 0.8
    assert (x.grad[outside] == 0).all()
    assert (x.grad[~outside] != 0).all()


@pytest.mark.parametrize("path", ["kernels", "torch_path"])
def test_a_nan_in_the_render_reaches_the_loss(request, path):
    request.getfixturevalue(path)
    x, y = images(17, 33)
    x[1, 2, 3] = math.nan
    pack = photometric_loss(x, y)
    assert all(value.isnan() for value in (pack.total, *pack.parts.values()))


def test_images_that_are_not_contiguous_are_fine(kernels):
    x, y = images(33, 17)
    value, gradient = value_and_gradient(x.transpose(1, 2), y.transpose(1, 2))
    expected, expected_gradient = value_and_gradient(x, y)
    assert value == pytest.approx(expected, abs=1e-6)
    torch.testing.assert_close(gradient, expected_gradient.transpose(1, 2), rtol=1e-4, atol=1e-8)


def test_no_gradient_is_computed_when_none_is_asked_for(kernels):
    x, y = images(17, 33)
    assert not ssim(x, y).requires_grad
    assert ssim(x.requires_grad_(), y).requires_grad


def test_a_batch_is_the_mean_of_its_images(kernels):
    (a, b), (c, d) = images(12, 13, seed=1), images(12, 13, seed=2)
    batch = ssim(torch.stack([a, c]), torch.stack([b, d]))
    assert batch.item() == pytest.approx((ssim(a, b).item() + ssim(c, d).item()) / 2, abs=1e-6)


def test_images_that_do_not_match_are_refused():
    x, y = images(12, 13)
    with pytest.raises(ShapeError, match=r"\[3, 12, 13\] and \[3, 12, 12\]"):
        ssim(x, y[..., 1:])
    with pytest.raises(ShapeError, match=r"float32.*float64"):
        photometric_loss(x, y.double())
    with pytest.raises(ShapeError, match=r"10 x 12 pixels is too small .* 11 x 11"):
        ssim(x[..., :10], y[..., :10], padding="valid")
    with pytest.raises(ValueError, match="padding is 'zero'"):
        ssim(x, y, padding="zero")


@pytest.mark.slow
def test_the_compiled_loss_is_vectorised(kernels, monkeypatch):
    # Scalar code is about as slow as torch's vectorised convolutions; see benchmarks/training_ops.py.
    x, y = images(270, 480)

    def seconds() -> float:
        taken = []
        for _ in range(10):
            start = time.perf_counter()
            value_and_gradient(x, y)
            taken.append(time.perf_counter() - start)
        return min(taken)

    compiled = seconds()
    monkeypatch.setattr(photometric, "TRAINING", SimpleNamespace(try_load=lambda: False))
    assert compiled < seconds() / 3
