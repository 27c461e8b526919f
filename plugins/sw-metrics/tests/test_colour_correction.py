"""Colour correction: closed forms, rank-deficient pictures, and the quadratic one against its steps in plain numpy."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from sw_metrics.colour_correction import (
    affine,
    cc_gain,
    cc_psnr,
    cc_psnr_channel,
    cc_psnr_quad,
    cc_ssim,
    quadratic,
)

from splatwizard_core.api import psnr


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def photograph(seed: int = 0, size: int = 64) -> torch.Tensor:
    """[3,H,W] uniform on 0.2 .. 0.8, float64."""
    return 0.2 + 0.6 * torch.rand(3, size, size, generator=generator(seed), dtype=torch.float64)


def test_an_affine_change_of_colours_is_undone():
    y = photograph()
    matrix = torch.tensor([[0.9, 0.05, 0.0], [0.0, 0.8, 0.1], [0.02, 0.0, 0.95]], dtype=torch.float64)
    x = torch.einsum("ij,jhw->ihw", matrix, y) + 0.02
    assert psnr(x, y) == pytest.approx(30, abs=1)
    assert cc_psnr(x, y) > 200
    assert cc_gain(x, y) > 150
    assert cc_ssim(x, y) == pytest.approx(1, abs=1e-5)  # float32 moments


def test_noise_alone_gains_by_shrinkage():
    y = photograph(size=400)
    x = (y + 0.05 * torch.randn(y.shape, generator=generator(1), dtype=torch.float64)).clamp(0, 1)
    s2, n2 = 0.03, 0.05**2
    assert psnr(x, y) == pytest.approx(26.02, abs=0.02)
    assert cc_psnr(x, y) == pytest.approx(-10 * math.log10(s2 * n2 / (s2 + n2)), abs=0.02)  # 26.37
    assert cc_gain(x, y) == pytest.approx(0.35, abs=0.02)


@pytest.mark.parametrize("seed", range(4))
def test_before_clipping_the_affine_one_contains_the_others(seed: int):
    y = photograph(seed)
    x = 0.9 * y.roll(1, dims=0) + 0.05 * torch.rand(y.shape, generator=generator(seed), dtype=torch.float64)
    assert cc_psnr(x, y) >= cc_psnr_channel(x, y) - 1e-6
    assert cc_psnr(x, y) >= psnr(x, y) - 1e-9


def test_equal_pictures_are_infinite():
    y = photograph()
    assert cc_psnr(y, y) == math.inf
    assert cc_gain(y, y) == 0


@pytest.mark.parametrize("kind", ["constant", "grey", "black", "white", "one pixel"])
def test_pictures_without_enough_colours_have_finite_values(kind: str):
    y = photograph(size=1 if kind == "one pixel" else 16)
    x = {
        "constant": torch.full_like(y, 0.3), "grey": y[:1].expand(3, -1, -1), "black": torch.zeros_like(y),
        "white": torch.ones_like(y), "one pixel": y * 0.5,
    }[kind]  # fmt: skip
    assert torch.isfinite(affine(x, y)).all()
    assert torch.isfinite(quadratic(x, y)).all()
    if kind in ("constant", "black", "white"):
        variance = (y - y.mean(dim=(1, 2), keepdim=True)).square().mean()
        assert cc_psnr(x, y) == pytest.approx(-10 * math.log10(variance))
        assert cc_psnr_channel(x, y) == pytest.approx(-10 * math.log10(variance))


def test_a_clipped_picture_stays_under_the_quadratic_correction():
    y = photograph(size=16)
    x = torch.zeros_like(y)
    assert torch.equal(quadratic(x, y), x)


def literal(img: np.ndarray, ref: np.ndarray) -> np.ndarray:
    """The steps as the specification has them, on [n,3]."""
    original, current = img, img
    for _ in range(5):
        r, g, b = current.T
        a = np.stack([r * r, r * g, r * b, g * g, g * b, b * b, r, g, b, np.ones_like(r)], axis=1)
        columns = []
        for c in range(3):
            fits = np.ones(len(a), dtype=bool)
            for z in (original[:, c], current[:, c], ref[:, c]):
                fits &= (z >= 0.5 / 255) & (z <= 1 - 0.5 / 255)
            columns.append(a @ np.linalg.lstsq(a[fits], ref[fits, c], rcond=None)[0])
        current = np.clip(np.stack(columns, axis=1), 0, 1)
    return current


@pytest.mark.parametrize("seed", range(3))
def test_the_quadratic_correction_takes_the_steps_of_its_source(seed: int):
    y = torch.rand(3, 40, 30, generator=generator(seed), dtype=torch.float64)
    x = y**1.3 + 0.1 * y.roll(1, dims=0) + 0.02 * torch.randn(y.shape, generator=generator(9), dtype=torch.float64)
    x = x.clamp(0, 1)  # some values are clipped
    found = quadratic(x, y).flatten(1).T.numpy()
    expected = literal(x.flatten(1).T.numpy(), y.flatten(1).T.numpy())
    np.testing.assert_allclose(found, expected, atol=1e-8)  # normal equations lose half of the digits
    assert cc_psnr_quad(x, y) > psnr(x, y)
