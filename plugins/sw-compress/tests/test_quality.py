"""Decibels against closed forms."""

import math

import pytest
from sw_compress.quality import decibels, loss_against_photographs, told_loss


def test_equal_pictures_have_the_largest_psnr():
    assert decibels(0.0) == 100.0
    assert decibels(1e-4) == pytest.approx(40.0)


@pytest.mark.parametrize(("psnr", "photographs", "loss"), [(40, 27.5, 0.24), (40, 32.5, 0.71), (40, 35.8, 1.40),
                                                           (45, 27, 0.07), (38, 36, 2.12)])  # fmt: skip
def test_errors_add_as_squares(psnr: float, photographs: float, loss: float):
    assert loss_against_photographs(psnr, photographs) == pytest.approx(loss, abs=0.006)
    both = -10 * math.log10(10 ** (-photographs / 10) + 10 ** (-psnr / 10))
    assert photographs - both == pytest.approx(loss_against_photographs(psnr, photographs), abs=1e-9)


def test_the_loss_is_told_in_a_sentence():
    assert told_loss(40.1) == (
        "40.1 dB to the source: it costs 0.21 / 0.63 / 1.43 dB of photographs that the source meets at 27 / 32 / 36 dB"
    )
