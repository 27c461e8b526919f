"""Rate-distortion charts of a page as one SVG file of their own: for a README, a slide, a message."""

from __future__ import annotations

import re
from collections.abc import Sequence
from importlib import resources

from markupsafe import Markup

from sw_report.charts import HEIGHT, STYLES, WIDTH
from sw_report.method_styles import styles_of
from sw_report.plots import distortion_charts
from sw_report.runs import Run

FILE_NAME = "rd.svg"
MARGIN, GAP, HEAD, CAPTION, LEGEND_LINE = 16, 24, 40, 20, 22
LETTER = 6.6  # px that a letter of the legend takes at most, at 12 px
STYLE = """
text { fill: var(--muted); font: 11.5px ui-sans-serif, system-ui, "Segoe UI", Roboto, "Liberation Sans", sans-serif; }
.paper { fill: var(--paper); }
.title { fill: var(--ink); font-size: 15px; font-weight: 600; }
.name, .axis-label, .point-label { fill: var(--ink); }
.name { font-size: 12px; }
.grid { stroke: var(--rule); fill: none; }
.frame, .tick { stroke: var(--strong); fill: none; }
.line { fill: none; stroke: currentColor; stroke-width: 1.8; stroke-linejoin: round; }
.dashed { stroke-dasharray: 5 4; }
.point path { fill: currentColor; stroke: var(--paper); stroke-width: 1.2; }
.target { fill-opacity: 0; }
"""


def rd_svg(runs: Sequence[Run], title: str) -> str | None:
    """Quality against bytes, one chart per metric beside the other, one line per method; None if nothing can be drawn.

    runs    of one scene under one protocol
    """
    charts = distortion_charts(runs, styles_of(runs))
    if charts is None:
        return None
    width = 2 * MARGIN + len(charts.figures) * (WIDTH + GAP) - GAP
    parts = []
    for i, figure in enumerate(charts.figures):
        # A nested drawing without a size would take that of the whole.
        sized = Markup(str(figure.svg).replace("<svg ", f'<svg width="{WIDTH}" height="{HEIGHT}" ', 1))
        parts.append(
            Markup('<g transform="translate({},{})"><text class="name" y="-6">{}</text>{}</g>').format(
                MARGIN + i * (WIDTH + GAP), HEAD + CAPTION, figure.caption, sized
            )
        )
    x, y = float(MARGIN), float(HEAD + CAPTION + HEIGHT + 8)
    for key, name in charts.legend:
        room = 28 + 8 + LETTER * len(name) + 18
        if x > MARGIN and x + room > width - MARGIN:
            x, y = float(MARGIN), y + LEGEND_LINE
        parts.append(
            Markup('<g transform="translate({:.1f},{:.1f})">{}<text class="name" x="36" y="11">{}</text></g>').format(
                x, y, key, name
            )
        )
        x += room
    y += LEGEND_LINE * bool(charts.legend)
    for note in charts.notes:
        parts.append(Markup('<text x="{}" y="{:.1f}">{}</text>').format(MARGIN, y + 11, note))
        y += LEGEND_LINE
    height = y + MARGIN / 2
    drawn = Markup(
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {} {:.0f}" width="{}" height="{:.0f}" role="img" '
        'aria-label="{}"><style>{}</style><rect class="paper" width="100%" height="100%"/>'
        '<text class="title" x="{}" y="26">{}</text>{}</svg>\n'
    ).format(width, height, width, height, title, Markup(_style()), MARGIN, title, Markup("").join(parts))
    return str(drawn)


def themes() -> tuple[dict[str, str], dict[str, str]]:
    """Colours of the page by the names of their variables (`--s0`), in the light and in the dark theme."""
    sheet = resources.files("sw_report").joinpath("templates/style.css").read_text("utf-8")
    blocks = re.findall(r"\{\s*color-scheme: (?:light|dark);([^}]*)\}", sheet)
    light, dark = (dict(re.findall(r"(--\w+): (#\w+);", block)) for block in blocks[:2])
    return light, dark


def _style() -> str:
    """Style rules with the colours of the page, in both themes; no variables, which few drawing programs know."""
    light, dark = map(_coloured, themes())
    return f"{light} @media (prefers-color-scheme: dark) {{ {dark} }}"


def _coloured(colours: dict[str, str]) -> str:
    rules = STYLE + "".join(f".s{i} {{ color: var(--s{i}); }}\n" for i in range(STYLES))
    return re.sub(r"var\((--\w+)\)", lambda match: colours[match[1]], rules).replace("\n", " ").strip()
