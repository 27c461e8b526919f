"""A small chart of characters: lines of points over a logarithmic axis, for a terminal."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

from sw_report.axes import Axis, fitted_axis, tick_labels

MARKERS = "●■▲◆▼✚★○□△◇▽"
PLAIN_MARKERS = "oxv#+*%@&=~s"  # for terminals without Unicode
PLAIN = -1
Segment = tuple[str, int]
"""Text, and the index of the line that it belongs to (PLAIN: none)."""


@dataclass(frozen=True)
class Curve:
    """(x, y) of its points, in any order; x > 0."""

    name: str
    points: Sequence[tuple[float, float]]


def text_plot(
    curves: Sequence[Curve], title: str, x_label: str, *, width: int = 64, height: int = 14, unicode: bool = True
) -> list[list[Segment]]:
    """Draw the lines of the chart, each as its segments, and a legend under it.

    width, height   characters inside the axes

    Raises ValueError if no curve has a point.
    """
    points = [point for curve in curves for point in curve.points]
    if not points:
        raise ValueError("a plot needs at least one point")
    x = fitted_axis([p[0] for p in points], 0, width - 1, log=True, pad=0.03)
    y = fitted_axis([p[1] for p in points], height - 1, 0)
    markers = MARKERS if unicode else PLAIN_MARKERS
    grid: list[list[Segment]] = [[(" ", PLAIN)] * width for _ in range(height)]
    for i, curve in enumerate(curves):
        _join(grid, sorted(curve.points), x, y, i, "·" if unicode else ".")
    for i, curve in enumerate(curves):
        for px, py in curve.points:
            grid[round(y.place(py))][round(x.place(px))] = (markers[i % len(markers)], i)
    return [[(title, PLAIN)], *_framed(grid, x, y, unicode), [(f"{x_label:>{width + _gutter(y) + 2}}", PLAIN)],
            *_legend(curves, markers, width)]  # fmt: skip


def _join(
    grid: list[list[Segment]], points: Sequence[tuple[float, float]], x: Axis, y: Axis, index: int, dot: str
) -> None:
    """Straight lines between neighbours, in every other column that nobody has."""
    for (ax, ay), (bx, by) in itertools.pairwise(points):
        start, end = x.place(ax), x.place(bx)
        for column in range(round(start) + 1, round(end)):
            row = round(y.place(ay) + (column - start) / (end - start) * (y.place(by) - y.place(ay)))
            if column % 2 == 0 and grid[row][column][0] == " ":
                grid[row][column] = (dot, index)


def _gutter(y: Axis) -> int:
    return max(map(len, tick_labels(y.ticks())), default=0)


def _framed(grid: list[list[Segment]], x: Axis, y: Axis, unicode: bool) -> list[list[Segment]]:
    wall, tick, corner, floor, stop = "│┤└─┴" if unicode else "|++-+"
    gutter, rows, stops = _gutter(y), y.ticks(), x.ticks()
    labels = {round(y.place(value)): text for value, text in zip(rows, tick_labels(rows), strict=True)}
    lines: list[list[Segment]] = []
    for i, cells in enumerate(grid):
        edge = f"{labels.get(i, ''):>{gutter}} {tick if i in labels else wall}"
        lines.append([(edge, PLAIN), *_merged(cells)])
    at = {round(x.place(value)): text for value, text in zip(stops, tick_labels(stops, log=True), strict=True)}
    width = len(grid[0])
    bottom = "".join(stop if i in at else floor for i in range(width))
    lines.append([(f"{'':>{gutter}} {corner}{bottom}", PLAIN)])
    below = [" "] * (width + 8)
    for column, text in at.items():
        left = max(0, column - len(text) // 2)
        if all(c == " " for c in below[max(0, left - 1) : left + len(text)]):
            below[left : left + len(text)] = text
    lines.append([(f"{'':>{gutter + 2}}{''.join(below).rstrip()}", PLAIN)])
    return lines


def _merged(cells: Sequence[Segment]) -> list[Segment]:
    """Neighbours of one line as one segment, without the blanks at the end."""
    found: list[Segment] = []
    for text, index in cells:
        if found and found[-1][1] == index:
            found[-1] = (found[-1][0] + text, index)
        else:
            found.append((text, index))
    if found and found[-1][1] == PLAIN:
        found[-1] = (found[-1][0].rstrip(), PLAIN)
    return found


def _legend(curves: Sequence[Curve], markers: str, width: int) -> list[list[Segment]]:
    lines: list[list[Segment]] = [[]]
    used = 0
    for i, curve in enumerate(curves):
        text = f"{markers[i % len(markers)]} {curve.name}"
        if used and used + len(text) > width:
            lines.append([])
            used = 0
        lines[-1] += [(text, i), ("   ", PLAIN)]
        used += len(text) + 3
    return lines
