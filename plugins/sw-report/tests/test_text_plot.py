"""The chart of characters: every point has its place, and the frame its numbers."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from sw_report.text_plot import MARKERS, Curve, text_plot

POINT = st.tuples(st.floats(1e-3, 1e4), st.floats(-100, 100))


def drawn(lines) -> list[str]:
    return ["".join(text for text, _ in line) for line in lines]


def test_a_plot_looks_like_this():
    curves = [Curve("a", [(1, 20.0), (10, 30.0), (100, 32.0)]), Curve("b", [(2, 22.0), (20, 31.0)])]
    assert drawn(text_plot(curves, "PSNR dB", "MB", width=30, height=7)) == [
        "PSNR dB",
        "   │                          · ●",
        "30 ┤              ● · ·■· · ·",
        "   │            · · ·",
        "25 ┤        · · ·",
        "   │      · ·",
        "   │  · ·■",
        "20 ┤ ●",
        "   └─┴────────────┴─────────────┴─",
        "     1           10            100",
        "                                MB",
        "● a   ■ b   ",
    ]


@given(st.lists(st.lists(POINT, min_size=1, max_size=6), min_size=1, max_size=5), st.integers(20, 90))
def test_a_plot_keeps_to_its_room_and_shows_every_curve(curves, width):
    lines = text_plot([Curve(f"m{i}", points) for i, points in enumerate(curves)], "y", "x", width=width, height=12)
    frame = lines[1:13]
    assert all(len("".join(text for text, _ in line)) <= width + 14 for line in frame)
    marks = {index for line in frame for text, index in line if any(c in MARKERS for c in text)}
    assert len(curves) - 1 in marks  # the last is drawn over the others
    assert len("".join(drawn(lines[15:]))) >= sum(len(f"m{i}") for i in range(len(curves)))


def test_without_unicode_it_is_ascii():
    assert "".join(drawn(text_plot([Curve("a", [(1, 2), (3, 4)])], "y", "x", unicode=False))).isascii()


def test_one_point_is_a_plot_and_none_is_not():
    assert sum("●" in line for line in drawn(text_plot([Curve("a", [(5, 7)])], "y", "x"))) == 2  # and the legend
    with pytest.raises(ValueError, match="at least one point"):
        text_plot([Curve("a", [])], "y", "x")
