"""BD-rate and BD-PSNR: closed forms, and an independent implementation."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sw_report.rate_distortion import bd_quality, bd_rate, pareto_front

from splatwizard_core.errors import UserInputError

RATES = [1.0e6, 2.0e6, 4.1e6, 9.0e6]
PSNR = [30.1, 32.0, 33.4, 34.2]
# The example in the README of the package `bjontegaard` (kbit/s and dB of two libx265 presets).
EXAMPLE_ANCHOR = ([9487.76, 4593.60, 2486.44, 1358.24], [40.037, 38.615, 36.845, 34.851])
EXAMPLE_TEST = ([9787.80, 4469.00, 2451.52, 1356.24], [40.121, 38.651, 36.970, 34.987])


@st.composite
def curves(draw: st.DrawFn, points: int | None = None) -> tuple[list[float], list[float]]:
    """Rate and quality both rise."""
    n = points or draw(st.integers(4, 8))
    steps = st.floats(0.05, 1.0)
    rates = np.cumsum([draw(steps) for _ in range(n)]) + draw(st.floats(3, 5))
    quality = np.cumsum([draw(steps) for _ in range(n)]) + draw(st.floats(24, 27))
    return (10**rates).tolist(), quality.tolist()


@settings(deadline=None)  # the first call imports scipy or matplotlib
@given(curves())
def test_a_curve_against_itself_is_zero(curve):
    assert bd_rate(curve, curve).value == 0
    assert bd_quality(curve, curve).value == 0
    assert bd_rate(curve, curve).overlap == 1


@settings(deadline=None)  # the first call imports scipy or matplotlib
@given(curves(), st.floats(0.1, 10))
def test_a_rate_scaled_everywhere_gives_that_factor(curve, factor):
    rates, quality = curve
    result = bd_rate(curve, ([r * factor for r in rates], quality))
    assert result.value == pytest.approx((factor - 1) * 100, abs=1e-6)


def test_half_the_rate_everywhere_is_minus_fifty_percent():
    halved = [r / 2 for r in RATES]
    assert bd_rate((RATES, PSNR), (halved, PSNR)).value == pytest.approx(-50, abs=1e-9)
    assert bd_rate((RATES, PSNR), (halved, PSNR), method="cubic").value == pytest.approx(-50, abs=1e-9)


@settings(deadline=None)  # the first call imports scipy or matplotlib
@given(curves(), st.floats(-3, 3))
def test_a_quality_shifted_everywhere_is_that_shift(curve, shift):
    rates, quality = curve
    assert bd_quality(curve, (rates, [q + shift for q in quality])).value == pytest.approx(shift, abs=1e-9)


def test_straight_lines_give_the_area_between_them():
    """Q = 10 log10 R and Q = 10 log10 R + 2: everywhere 2 dB better, or 10^-0.2 of the rate."""
    rates = [1e5, 1e6, 1e7]
    anchor, test = [50.0, 60.0, 70.0], [52.0, 62.0, 72.0]
    quality, rate = bd_quality((rates, anchor), (rates, test)), bd_rate((rates, anchor), (rates, test))
    assert quality.value == pytest.approx(2, abs=1e-12)
    assert rate.value == pytest.approx((10**-0.2 - 1) * 100, abs=1e-9)
    assert quality.flags == rate.flags == ("few_points",)


def test_the_order_of_points_does_not_matter():
    turned = (RATES[::-1], PSNR[::-1])
    other = ([r * 1.3 for r in RATES], [q + 0.4 for q in PSNR])
    assert bd_rate(turned, other) == bd_rate((RATES, PSNR), other)
    assert bd_quality(turned, other) == bd_quality((RATES, PSNR), other)


@settings(deadline=None)  # the first call imports scipy or matplotlib
@given(st.data())
def test_an_independent_implementation_agrees(data):
    bjontegaard = pytest.importorskip("bjontegaard")
    anchor, test = data.draw(curves()), data.draw(curves())
    named = {"require_matching_points": False, "min_overlap": 0}
    rate = bd_rate(anchor, test)
    if rate.value is not None and rate.overlap > 0.02:
        theirs = bjontegaard.bd_rate(*anchor, *test, method="pchip", **named)
        assert rate.value == pytest.approx(theirs, rel=1e-6, abs=1e-6)
    quality = bd_quality(anchor, test)
    if quality.value is not None and quality.overlap > 0.02:
        theirs = bjontegaard.bd_psnr(*anchor, *test, method="pchip", **named)
        assert quality.value == pytest.approx(theirs, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("method", ["pchip", "cubic"])
def test_the_published_example_gives_the_same(method):
    bjontegaard = pytest.importorskip("bjontegaard")
    ours = bd_rate(EXAMPLE_ANCHOR, EXAMPLE_TEST, method=method).value
    assert ours == pytest.approx(bjontegaard.bd_rate(*EXAMPLE_ANCHOR, *EXAMPLE_TEST, method=method), abs=1e-7)
    ours = bd_quality(EXAMPLE_ANCHOR, EXAMPLE_TEST, method=method).value
    assert ours == pytest.approx(bjontegaard.bd_psnr(*EXAMPLE_ANCHOR, *EXAMPLE_TEST, method=method), abs=1e-9)


def test_curves_without_a_common_range_have_no_value():
    above = ([r * 2 for r in RATES], [q + 10 for q in PSNR])
    assert bd_rate((RATES, PSNR), above).value is None
    assert bd_rate((RATES, PSNR), above).flags == ("no_overlap",)
    beyond = ([r * 1e3 for r in RATES], PSNR)
    assert bd_quality((RATES, PSNR), beyond) == bd_quality(beyond, (RATES, PSNR))
    assert bd_quality((RATES, PSNR), beyond).flags == ("no_overlap",)


def test_a_small_common_range_is_flagged():
    above = (RATES, [q + 3.2 for q in PSNR])  # 0.9 of 4.1 dB in common: 22 %
    result = bd_rate((RATES, PSNR), above)
    assert result.flags == ("low_overlap",)
    assert result.overlap == pytest.approx(0.9 / 4.1)
    assert result.value is not None
    assert bd_rate((RATES, PSNR), (RATES, [q + 3.0 for q in PSNR])).flags == ()


def test_one_range_inside_the_other_counts_by_the_wider():
    inside = (RATES, [31.0, 31.2, 31.5, 31.9])  # all of its own range, 0.9 of 4.1 dB of the anchor's
    assert bd_rate((RATES, PSNR), inside).flags == ("low_overlap",)


def test_falling_quality_is_an_error_for_the_rate_unless_filtered():
    dented = (RATES, [30.1, 32.0, 31.9, 34.2])
    with pytest.raises(UserInputError, match="curve of test a larger file is not better in SSIM"):
        bd_rate((RATES, PSNR), dented, metric="SSIM")
    filtered = bd_rate((RATES, PSNR), dented, pareto=True)
    assert filtered.value == bd_rate((RATES, PSNR), ([RATES[i] for i in (0, 1, 3)], [30.1, 32.0, 34.2])).value
    assert filtered.flags == ("few_points",)
    assert bd_quality((RATES, PSNR), dented).value < 0


def test_the_front_holds_what_nothing_smaller_beats():
    assert pareto_front([4, 1, 3, 2, 2], [8, 5, 6, 7, 6]) == ([1, 2, 4], [5, 7, 8])


@pytest.mark.parametrize(
    ("curve", "complaint"),
    [
        (([1e6], [30.0]), "at least 2 points, that of test has 1"),
        (([], []), "that of test has 0"),
        (([1e6, 2e6], [30.0]), "2 rates and 1 qualities"),
        (([1e6, 0.0], [30.0, 31.0]), "positive"),
        (([1e6, 2e6], [30.0, math.inf]), "finite"),
        (([1e6, 1e6], [30.0, 31.0]), "same rate"),
    ],
)
def test_what_makes_no_curve_is_refused(curve, complaint):
    for function in (bd_rate, bd_quality):
        with pytest.raises(UserInputError, match=complaint):
            function((RATES, PSNR), curve)
        with pytest.raises(UserInputError, match=complaint.replace("test", "hac")):
            function(curve, (RATES, PSNR), names=("hac", "mine"))


def test_the_classic_cubic_takes_exactly_four_points():
    five = ([*RATES, 2e7], [*PSNR, 34.9])
    with pytest.raises(UserInputError, match="exactly 4 points a curve, not 5"):
        bd_rate((RATES, PSNR), five, method="cubic")
