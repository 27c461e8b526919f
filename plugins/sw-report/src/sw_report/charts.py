"""Charts as inline SVG. Colours are classes of the page's style sheet, so that they follow its theme and its print.

Every mark has a `<title>` with its values, which a pointer shows and a screen reader can read. Text comes in as str and
is escaped here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from markupsafe import Markup

from sw_report.axes import Axis, fitted_axis, tick_labels

WIDTH, HEIGHT = 420, 260
LEFT, RIGHT, TOP, BOTTOM = 50, 16, 12, 40
STYLES = 8  # colours in the style sheet: classes s0 .. s7
DASHES = 4  # patterns of lines in the style sheet: solid, classes dash1 .. dash3

MARKERS = (
    "M-4,0a4,4 0 1,0 8,0a4,4 0 1,0 -8,0Z",  # circle
    "M-3.6,-3.6H3.6V3.6H-3.6Z",  # square
    "M0,-4.8L4.6,3.4H-4.6Z",  # triangle
    "M0,-5L5,0L0,5L-5,0Z",  # diamond
    "M0,4.8L4.6,-3.4H-4.6Z",  # triangle that points down
    "M-4.5,-1.5H-1.5V-4.5H1.5V-1.5H4.5V1.5H1.5V4.5H-1.5V1.5H-4.5Z",  # plus
    "M-4.6,0L-2.3,-4H2.3L4.6,0L2.3,4H-2.3Z",  # hexagon
    "M0,-5L1.5,-1.6L5,-1.5L2.3,0.9L3.1,4.4L0,2.5L-3.1,4.4L-2.3,0.9L-5,-1.5L-1.5,-1.6Z",  # star
)


@dataclass(frozen=True)
class Point:
    """x, y, what a pointer over it tells, and what stands beside it."""

    x: float
    y: float
    title: str = ""
    label: str = ""


@dataclass(frozen=True)
class Series:
    """One line of a chart.

    style   colour and marker, any number
    dashed  the line is dashed
    dash    pattern of the line, any number: 0 is solid; for lines of one colour
    marks   points are marked; False: the line alone
    joined  points are joined by a line
    """

    name: str
    points: Sequence[Point]
    style: int = 0
    dashed: bool = False
    marks: bool = True
    joined: bool = True
    dash: int = 0


@dataclass(frozen=True)
class Chart:
    """Contents of one chart.

    title       says what the chart shows, for those who do not see it
    levels      (y, what it is): horizontal lines across
    borders     (x, what begins there): vertical lines
    stops       (x, its name) in place of numbers along the axis
    """

    title: str
    series: Sequence[Series]
    x_label: str
    x_log: bool = False
    y_log: bool = False
    levels: Sequence[tuple[float, str]] = field(default=())
    borders: Sequence[tuple[float, str]] = field(default=())
    stops: Sequence[tuple[float, str]] = field(default=())

    def draw(self) -> Markup:
        """Return the SVG element. Raises ValueError if no series has a point."""
        points = [p for s in self.series for p in s.points]
        if not points:
            raise ValueError("a chart needs at least one point")
        x = fitted_axis([p.x for p in points], LEFT, WIDTH - RIGHT, log=self.x_log, pad=0.05)
        heights = [p.y for p in points] + [level for level, _ in self.levels]
        y = fitted_axis(heights, HEIGHT - BOTTOM, TOP, log=self.y_log)
        parts = [_grid(x, y, self.stops), *(_border(x, at, text) for at, text in self.borders)]
        parts += [_level(y, at, text) for at, text in self.levels]
        parts += [_series(s, x, y) for s in self.series if s.points]
        axis = Markup('<text class="axis-label" x="{:.1f}" y="{}" text-anchor="middle">{}</text>').format(
            (LEFT + WIDTH - RIGHT) / 2, HEIGHT - 6, self.x_label
        )
        return Markup('<svg class="chart" viewBox="0 0 {} {}" role="img" aria-label="{}">{}{}</svg>').format(
            WIDTH, HEIGHT, self.title, Markup("").join(parts), axis
        )


def _grid(x: Axis, y: Axis, named: Sequence[tuple[float, str]]) -> Markup:
    parts = []
    rows, stops = y.ticks(), x.ticks()
    named = named or list(zip(stops, tick_labels(stops, log=x.log), strict=True))
    for tick, text in zip(rows, tick_labels(rows, log=y.log), strict=True):
        at = y.place(tick)
        parts.append(
            Markup('<path class="grid" d="M{},{:.1f}H{}"/><text x="{}" y="{:.1f}" text-anchor="end">{}</text>').format(
                LEFT, at, WIDTH - RIGHT, LEFT - 7, at + 3.6, text
            )
        )
    floor = HEIGHT - BOTTOM
    for tick, text in named:
        at = x.place(tick)
        parts.append(
            Markup(
                '<path class="tick" d="M{:.1f},{}v4"/><text x="{:.1f}" y="{}" text-anchor="middle">{}</text>'
            ).format(at, floor, at, floor + 16, text)
        )
    parts.append(Markup('<path class="frame" d="M{},{}H{}"/>').format(LEFT, floor, WIDTH - RIGHT))
    return Markup("").join(parts)


def _level(y: Axis, at: float, text: str) -> Markup:
    place = y.place(at)
    return Markup(
        '<g class="level"><path d="M{},{:.1f}H{}"/><text x="{}" y="{:.1f}" text-anchor="end">{}</text></g>'
    ).format(LEFT, place, WIDTH - RIGHT, WIDTH - RIGHT, place - 5, text)


def _border(x: Axis, at: float, text: str) -> Markup:
    place = x.place(at)
    return Markup('<g class="level"><path d="M{:.1f},{}V{}"/><text x="{:.1f}" y="{}">{}</text></g>').format(
        place, TOP, HEIGHT - BOTTOM, place + 4, TOP + 9, text
    )


def _series(series: Series, x: Axis, y: Axis) -> Markup:
    at = [(x.place(p.x), y.place(p.y)) for p in series.points]
    parts = []
    if series.joined and len(at) > 1:
        line = "M" + "L".join(f"{px:.1f},{py:.1f}" for px, py in at)
        name = Markup("") if series.marks else Markup("<title>{}</title>").format(series.name)
        parts.append(
            Markup('<path class="line{}" d="{}">{}</path>').format(_pattern(series.dashed, series.dash), line, name)
        )
    if series.marks:
        shape = _marker(series.style)
        for (px, py), point in zip(at, series.points, strict=True):
            label = Markup("")
            if point.label:
                below = py < TOP + 16
                # Curves rise and flatten: above and to the left of a point is free, but for those at the upper edge.
                label = Markup('<text class="point-label" x="{}" y="{}" text-anchor="{}">{}</text>').format(
                    0 if below else -4, 17 if below else -6, "middle" if below else "end", point.label
                )
            parts.append(
                Markup(
                    '<g class="point" transform="translate({:.1f},{:.1f})"><title>{}</title>'
                    '<circle class="target" r="11"/><path d="{}"/>{}</g>'
                ).format(px, py, point.title, shape, label)
            )
    return Markup('<g class="s{}">{}</g>').format(series.style % STYLES, Markup("").join(parts))


def _pattern(dashed: bool, dash: int) -> str:
    """Classes of a line's pattern."""
    return " dashed" if dashed else f" dash{dash % DASHES}" if dash % DASHES else ""


def _marker(style: int) -> str:
    """Shape of a series: colours repeat after STYLES series, then each has another shape than before."""
    return MARKERS[(style + style // STYLES) % len(MARKERS)]


def swatch(style: int, *, dashed: bool = False, marks: bool = True, dash: int = 0) -> Markup:
    """Key of a series in a legend."""
    marker = Markup('<g class="point" transform="translate(14,7)"><path d="{}"/></g>').format(_marker(style))
    return Markup(
        '<svg class="swatch s{}" viewBox="0 0 28 14" width="28" height="14" aria-hidden="true">'
        '<path class="line{}" d="M1,7H27"/>{}</svg>'
    ).format(style % STYLES, _pattern(dashed, dash), marker if marks else Markup(""))


@dataclass(frozen=True)
class Bar:
    """One row of stacked bars: its name, what stands at its right, and its parts (style, size, title)."""

    name: str
    total: str
    parts: Sequence[tuple[int, float, str]]


def stacked_bars(title: str, rows: Sequence[Bar]) -> Markup:
    """Horizontal bars, each made of its parts, on one linear scale that begins at zero."""
    row_height, bar_height, top = 34, 13, 4
    widest = max(sum(size for _, size, _ in row.parts) for row in rows) or 1.0
    parts = []
    for i, row in enumerate(rows):
        y = top + i * row_height
        parts.append(
            Markup(
                '<text class="bar-name" x="0" y="{}">{}</text><text x="{}" y="{}" text-anchor="end">{}</text>'
            ).format(y + 11, row.name, WIDTH, y + 11, row.total)
        )
        at = 0.0
        for style, size, text in row.parts:
            width = size / widest * WIDTH
            if width > 0:
                parts.append(
                    Markup(
                        '<rect class="s{}{}" x="{:.2f}" y="{}" width="{:.2f}" height="{}"><title>{}</title></rect>'
                    ).format(style % STYLES, " pale" if style >= STYLES else "", at, y + 16, width, bar_height, text)
                )
            at += width
    height = top + len(rows) * row_height
    return Markup('<svg class="chart bars" viewBox="0 0 {} {}" role="img" aria-label="{}">{}</svg>').format(
        WIDTH, height, title, Markup("").join(parts)
    )


def square(style: int) -> Markup:
    """Key of a part of a bar."""
    return Markup(
        '<svg class="swatch bars" viewBox="0 0 14 14" width="14" height="14" aria-hidden="true">'
        '<rect class="s{}{}" x="1" y="1" width="12" height="12"/></svg>'
    ).format(style % STYLES, " pale" if style >= STYLES else "")
