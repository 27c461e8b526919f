"""Scores after the MPEG GSC exploration: closed forms of constants, an independent SSIM, masks."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from sw_bench.gsc.scores import psnr, score, ssim_map, to_yuv

from splatwizard_core.api import psnr as core_psnr

EVERYWHERE = torch.ones(24, 20, dtype=torch.bool)


def grey(*levels: int) -> torch.Tensor:
    return torch.tensor(levels, dtype=torch.uint8)[:, None, None].expand(3, 24, 20).contiguous()


def noisy(seed: int) -> torch.Tensor:
    return torch.randint(0, 256, (3, 24, 20), generator=torch.Generator().manual_seed(seed)).to(torch.uint8)


@pytest.mark.parametrize(("change", "rgb", "yuv", "y", "u", "v"), [
    ((10, 10, 10), 28.1308, 32.9020, 28.1308, None, None),
    ((10, 0, 0), 32.9020, 38.0118, 41.5795, 46.9471, 34.1514),
    ((0, 10, 0), 32.9020, 33.5251, 31.0423, 36.4126, 34.9859),
    ((0, 0, 10), 32.9020, 38.7974, 50.9601, 34.1514, 54.9135),
])  # fmt: skip
def test_a_constant_added_to_grey_has_its_closed_form(change, rgb, yuv, y, u, v):
    found = score(grey(100, 100, 100), grey(*(100 + each for each in change)), EVERYWHERE)
    assert found.psnr_rgb == pytest.approx(rgb, abs=1e-4)
    assert found.psnr_yuv == pytest.approx(yuv, abs=1e-4)
    for value, expected in ((found.psnr_y, y), (found.psnr_u, u), (found.psnr_v, v)):
        assert value == (None if expected is None else pytest.approx(expected, abs=1e-4))


@pytest.mark.parametrize(("change", "value"), [
    ((10, 0, 0), 41.3220), ((0, 10, 0), 32.2065), ((0, 0, 10), 49.3532), ((10, 10, 10), None),
])  # fmt: skip
def test_six_parts_of_luma_have_their_closed_form(change, value):
    found = score(grey(100, 100, 100), grey(*(100 + each for each in change)), EVERYWHERE).psnr_yuv_611
    assert found == (None if value is None else pytest.approx(value, abs=1e-4))


def test_the_planes_of_integers_are_near_those_of_floats():
    found = score(noisy(0), noisy(1), EVERYWHERE)
    assert found.psnr_yuv_qmiv == pytest.approx((4 * found.psnr_y + found.psnr_u + found.psnr_v) / 6, abs=0.02)


def test_the_rgb_psnr_is_that_of_the_core():
    a, b = noisy(2), noisy(3)
    assert score(a, b, EVERYWHERE).psnr_rgb == pytest.approx(core_psnr(a / 255, b / 255), abs=1e-6)  # a, b in float32


def test_equal_pictures_have_no_psnr_and_a_similarity_of_one():
    a = noisy(4)
    found = score(a, a, EVERYWHERE)
    assert (found.psnr_rgb, found.psnr_yuv, found.psnr_yuv_qmiv, found.om_psnr_rgb) == (None,) * 4
    assert found.ssim_yuv == 1.0
    assert psnr(0.0) is None


def test_the_similarity_is_the_definition_with_replicated_borders():
    a, b = (to_yuv(noisy(seed).double()) for seed in (5, 6))
    offsets = np.arange(11) - 5
    window = np.exp(-(offsets[:, None] ** 2 + offsets[None] ** 2) / (2 * 1.5**2))
    window /= window.sum()
    found = ssim_map(a, b).numpy()
    for plane in range(3):
        x, y = (np.pad(each[plane].numpy(), 5, mode="edge") for each in (a, b))
        for i, j in ((0, 0), (3, 19), (12, 7), (23, 0)):
            p, q = x[i : i + 11, j : j + 11], y[i : i + 11, j : j + 11]
            mp, mq = (window * p).sum(), (window * q).sum()
            vp, vq = (window * (p - mp) ** 2).sum(), (window * (q - mq) ** 2).sum()
            c = (window * (p - mp) * (q - mq)).sum()
            c1, c2 = 2.55**2, 7.65**2
            expected = (2 * mp * mq + c1) * (2 * c + c2) / ((mp**2 + mq**2 + c1) * (vp + vq + c2))
            assert found[plane, i, j] == pytest.approx(expected, abs=1e-9)


def test_a_mask_of_all_is_none_and_an_empty_one_has_no_value():
    a, b = noisy(7), noisy(8)
    full = score(a, b, EVERYWHERE)
    assert (full.om_psnr_rgb, full.om_ssim_yuv, full.occupancy) == (full.psnr_rgb, full.ssim_yuv, 100.0)
    masked = ssim_map(*(to_yuv(each.double()) for each in (a, b)), EVERYWHERE)
    assert masked.mean().item() == pytest.approx(full.ssim_yuv, abs=1e-12)
    empty = score(a, b, ~EVERYWHERE)
    assert (empty.om_psnr_rgb, empty.om_ssim_yuv, empty.occupancy) == (None, None, 0.0)
    dot = ~EVERYWHERE
    dot[5, 5] = True
    found = score(a, b, dot)
    assert found.om_psnr_rgb is not None
    assert found.om_ssim_yuv is None  # no window holds enough of it


def test_what_lies_outside_the_mask_does_not_matter():
    a, b = noisy(9), noisy(10)
    mask = torch.zeros(24, 20, dtype=torch.bool)
    mask[4:20, 3:16] = True
    other = torch.where(mask, b, noisy(11))
    found, again = score(a, b, mask), score(a, other, mask)
    assert found.om_psnr_rgb == again.om_psnr_rgb
    assert found.om_ssim_yuv == pytest.approx(again.om_ssim_yuv, abs=1e-12)
    assert found.occupancy == pytest.approx(100 * 16 * 13 / (24 * 20))
    assert found.psnr_rgb != again.psnr_rgb
