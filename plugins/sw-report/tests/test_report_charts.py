"""Axes and SVG: what a chart shows, and that nothing in it is code."""

import itertools
import math
from xml.etree import ElementTree

import pytest
from hypothesis import given
from hypothesis import strategies as st
from sw_report.axes import Axis, fitted_axis, linear_ticks, log_ticks, tick_labels
from sw_report.charts import (
    HEIGHT,
    LEFT,
    MARKERS,
    WIDTH,
    Bar,
    Chart,
    Point,
    Series,
    square,
    stacked_bars,
    swatch,
)

HOSTILE = "<script>alert('x')</script>\"&]]>"
NUMBERS = st.floats(-1e9, 1e9, allow_nan=False)


def parsed(svg: object) -> ElementTree.Element:
    return ElementTree.fromstring(str(svg))


@given(st.lists(NUMBERS, min_size=1, max_size=20))
def test_a_linear_axis_holds_all_values_in_order(values):
    axis = fitted_axis(values, 0, 100)
    at = [axis.place(v) for v in sorted(values)]
    assert all(-1e-6 <= p <= 100 + 1e-6 for p in at)
    assert at == sorted(at)


@given(st.lists(st.floats(1e-6, 1e12), min_size=1, max_size=20))
def test_a_logarithmic_axis_gives_equal_ratios_equal_lengths(values):
    axis = fitted_axis(values, 10, 300, log=True)
    assert all(10 - 1e-6 <= axis.place(v) <= 300 + 1e-6 for v in values)
    low = axis.low * 1.0001
    assert axis.place(low * 2) - axis.place(low) == pytest.approx(axis.place(low * 6) - axis.place(low * 3))


@given(NUMBERS, st.floats(1e-3, 1e9))
def test_linear_ticks_are_few_even_and_inside(low, width):
    ticks = linear_ticks(low, low + width)
    slack = 1e-6 * max(abs(low), width)
    assert 1 <= len(ticks) <= 7
    assert all(low - slack <= t <= low + width + slack for t in ticks)
    steps = [b - a for a, b in itertools.pairwise(ticks)]
    assert all(s == pytest.approx(steps[0], rel=1e-3, abs=slack) for s in steps)


@given(st.floats(-3, 9), st.floats(0.05, 6))
def test_logarithmic_ticks_are_few_and_inside(exponent, decades):
    low, high = 10**exponent, 10 ** (exponent + decades)
    ticks = log_ticks(low, high)
    assert 1 <= len(ticks) <= 7
    assert all(low * (1 - 1e-9) <= t <= high * (1 + 1e-9) for t in ticks)


def test_ticks_in_the_usual_places():
    assert linear_ticks(28.9, 31.6) == [29.0, 29.5, 30.0, 30.5, 31.0, 31.5]
    assert log_ticks(1.5, 60) == [2, 5, 10, 20, 50]
    assert log_ticks(1.1, 1e5) == [10, 100, 1000, 10_000, 100_000]


@pytest.mark.parametrize(
    ("values", "log", "texts"),
    [
        ([0.94, 0.9, 0.86], False, ["0.94", "0.90", "0.86"]),
        ([0, 50_000, 100_000], False, ["0", "50k", "100k"]),
        ([0, 2000, 4000], False, ["0", "2000", "4000"]),
        ([1.5e7, 2e7], False, ["15M", "20M"]),
        ([0.02, 0.5, 10, 20_000], True, ["0.02", "0.5", "10", "20k"]),
    ],
)
def test_tick_labels_are_short_and_alike(values, log, texts):
    assert tick_labels(values, log=log) == texts


def test_a_point_lies_where_its_values_say_and_tells_them():
    points = [Point(1, 30, "r1: 30 dB at 1 MB"), Point(10, 32, "r2: 32 dB at 10 MB")]
    svg = parsed(Chart("PSNR", [Series("toy", points)], "MB", x_log=True).draw())
    marks = [g for g in svg.iter("g") if g.get("class") == "point"]
    assert [m.find("title").text for m in marks] == [p.title for p in points]
    at = [tuple(map(float, m.get("transform")[10:-1].split(","))) for m in marks]
    assert LEFT < at[0][0] < at[1][0] < WIDTH
    assert 0 < at[1][1] < at[0][1] < HEIGHT  # 32 dB stands higher
    assert svg.get("role") == "img"
    assert svg.get("aria-label") == "PSNR"


def test_a_chart_of_one_point_has_a_size():
    svg = str(Chart("one", [Series("a", [Point(5, 7)])], "x").draw())
    assert "nan" not in svg
    assert parsed(svg) is not None


def test_a_chart_without_points_is_refused():
    with pytest.raises(ValueError, match="at least one point"):
        Chart("none", [Series("a", [])], "x").draw()


def test_whatever_names_hold_stays_text():
    chart = Chart(
        HOSTILE, [Series(HOSTILE, [Point(1, 1, HOSTILE, HOSTILE)]), Series(HOSTILE, [Point(2, 2)] * 2, marks=False)],
        HOSTILE, levels=[(1.0, HOSTILE)], borders=[(1.5, HOSTILE)],
    ).draw()  # fmt: skip
    bars = stacked_bars(HOSTILE, [Bar(HOSTILE, HOSTILE, [(0, 1.0, HOSTILE)])])
    for svg in (chart, bars):
        tree = parsed(svg)
        assert {element.tag for element in tree.iter()} <= {"svg", "g", "path", "text", "title", "circle", "rect"}
        assert HOSTILE in [element.text for element in tree.iter()]
        assert tree.get("aria-label") == HOSTILE


def test_bars_are_as_long_as_their_parts():
    svg = parsed(
        stacked_bars("bytes", [Bar("a", "", [(0, 30.0, "x"), (9, 70.0, "y")]), Bar("b", "", [(0, 50.0, "x")])])
    )
    rects = list(svg.iter("rect"))
    assert [float(r.get("width")) for r in rects] == pytest.approx([0.3 * WIDTH, 0.7 * WIDTH, 0.5 * WIDTH], abs=0.01)
    assert float(rects[1].get("x")) == pytest.approx(0.3 * WIDTH, abs=0.01)
    assert rects[1].get("class") == "s1 pale"


def test_keys_of_legends_are_drawn_like_their_series():
    assert all(parsed(swatch(i, dashed=True)) is not None for i in range(len(MARKERS)))
    assert parsed(swatch(2, marks=False)).get("class") == "swatch s2"
    assert parsed(square(10)).find("rect").get("class") == "s2 pale"


def test_an_axis_maps_its_ends():
    assert Axis(1, 100, 0, 50, log=True).place(10) == pytest.approx(25)
    assert math.isclose(Axis(0, 4, 10, 20).place(1), 12.5)
