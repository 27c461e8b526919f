"""Flicker along a path: closed forms of errors that alternate, drift, appear once, or are noise."""

from __future__ import annotations

import math

import pytest
import torch
from sw_report.path_flicker import PathFlicker


def measured(errors: list[float], base: list[float] | None = None) -> dict:
    """Of frames whose levels are `base` (default 100) and `base` + error."""
    path = PathFlicker()
    for t, error in enumerate(errors):
        level = 100.0 if base is None else base[t]
        reference = torch.full((3, 4, 5), level / 255)
        path.add(reference, reference + error / 255)
    return path.result()


def test_an_error_that_stays_does_not_flicker():
    found = measured([7] * 5)
    assert (found["flicker"], found["flicker1"]) == (0, 0)
    assert found["psnr"] == pytest.approx(20 * math.log10(255 / 7))


def test_one_that_alternates_flickers_most():
    found = measured([6, -6] * 5)
    assert found["flicker"] == pytest.approx(4 * 6)
    assert found["flicker1"] == pytest.approx(2 * 6)


def test_one_that_drifts_evenly_has_first_differences_alone():
    found = measured([3 * t for t in range(8)])
    assert found["flicker"] == pytest.approx(0)
    assert found["flicker1"] == pytest.approx(3)


def test_one_bad_frame_of_ten():
    found = measured([0] * 4 + [9] + [0] * 5)
    assert found["flicker"] == pytest.approx(9 * math.sqrt(6 / 8))
    assert found["flicker1"] == pytest.approx(9 * math.sqrt(2 / 9))


def test_noise_has_its_variance_times_six_and_two():
    g = torch.Generator().manual_seed(0)
    path = PathFlicker()
    for _ in range(60):
        reference = torch.full((3, 40, 40), 128 / 255)
        path.add(reference, reference + 10 / 255 * torch.randn(3, 40, 40, generator=g))
    found = path.result()
    assert found["flicker"] == pytest.approx(10 * math.sqrt(6), rel=0.01)  # rounding adds 1/12 to a variance of 100
    assert found["flicker1"] == pytest.approx(10 * math.sqrt(2), rel=0.01)


def test_backwards_it_is_the_same():
    errors = [0, 3, -2, 8, 8, 1]
    base = [100, 101, 104, 120, 90, 91]
    there, back = measured(errors, base), measured(errors[::-1], base[::-1])
    assert there == pytest.approx(back)


def test_a_jump_pops():
    even = measured([0] * 12, [10 + 2 * t + t % 2 for t in range(12)])
    assert even["popping_a"] == pytest.approx(1)
    jump = measured([0] * 12, [10 + 2 * t + t % 2 + (40 if t == 6 else 0) for t in range(12)])
    assert jump["popping_a"] > 20
    assert jump["popping_a"] == jump["popping_b"]


def test_too_few_frames_have_no_value():
    assert measured([5])["flicker1"] is None
    found = measured([5, 6])
    assert (found["flicker"], found["popping_a"]) == (None, None)
    assert found["flicker1"] == pytest.approx(1)
    assert measured([0, 0, 0])["psnr"] is None
