"""Shared-out precision against closed forms and against all combinations."""

import itertools

import numpy as np
import pytest
from sw_compress.allocation import Curve, at_price, within

LEVELS = np.arange(-6, 6.5, 0.5)


def curve(name: str, count: float, sensitivity: float, *, whole: bool = False) -> Curve:
    """A uniform quantiser at high rate: a bit for each octave, an error that grows with the square of the step."""
    return Curve(name, LEVELS, count * (10 - LEVELS) / 8, sensitivity * 4.0**LEVELS, whole)


def test_errors_of_each_number_are_equal_at_the_optimum():
    curves = [curve("a", 3000, 1e-4).finer(), curve("b", 1000, 1e-6).finer()]
    found = within(curves, 4000.0)
    errors = {c.name: c.error[abs(c.levels - found.levels[c.name]).argmin()] for c in curves}
    assert errors["a"] / 3000 == pytest.approx(errors["b"] / 1000, rel=0.3)  # levels are an eighth of half an octave
    assert 0.99 * 4000 < found.bytes <= 4000


def test_no_combination_of_levels_is_better():
    curves = [curve(name, n, s, whole=False) for name, n, s in (("a", 300, 1e-4), ("b", 200, 3e-5), ("c", 50, 1e-3))]
    found = within([c.finer() for c in curves], 500.0)
    best = min(
        sum(c.error[i] for c, i in zip(curves, places, strict=True))
        for places in itertools.product(range(len(LEVELS)), repeat=3)
        if sum(c.bytes[i] for c, i in zip(curves, places, strict=True)) <= 500
    )
    assert found.error <= best * 1.02


def test_an_attribute_in_whole_levels_stays_on_them():
    curves = [curve("a", 300, 1e-4, whole=True).finer(), curve("b", 200, 3e-5).finer()]
    found = within(curves, 400.0)
    assert found.levels["a"] in LEVELS
    assert 0.99 * 400 < found.bytes <= 400


def test_a_budget_below_the_coarsest_is_none():
    assert within([curve("a", 300, 1e-4).finer()], 1.0) is None


def test_a_higher_price_never_gives_more_bytes():
    curves = [curve("a", 300, 1e-4).finer(), curve("b", 200, 3e-5).finer()]
    sizes = [at_price(curves, price).bytes for price in np.geomspace(1e-12, 1e2, 80)]
    assert all(np.diff(sizes) <= 0)


def test_curves_are_made_monotone():
    bumpy = Curve("a", LEVELS[:4], np.array([9.0, 10, 7, 8]), np.array([1.0, 0.5, 2, 3])).finer()
    assert all(np.diff(bumpy.bytes) <= 0)
    assert all(np.diff(bumpy.error) >= 0)
