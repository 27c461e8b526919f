"""Rate-distortion curves for papers, drawn by matplotlib: SVG and PDF with the colours and markers of the page."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatwizard_core.api import UserInputError
from splatwizard_core.tooling import write_atomic
from sw_report import numbers
from sw_report.aggregate import DatasetTable, dataset_tables
from sw_report.charts import STYLES
from sw_report.distance import DISTANCE_LABEL, reached, with_distances
from sw_report.distortion import drawn_metrics
from sw_report.method_styles import styles_of
from sw_report.plots import counts_anchors
from sw_report.prefixes import prefix_metrics, with_prefixes
from sw_report.rd_file import themes
from sw_report.runs import Run

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FORMS = ("svg", "pdf")
MARKERS = "os^DvPh*"  # in the order of `charts.MARKERS`
DASHES = ("-", "--", "-.", ":")
PANEL = (3.4, 2.6)  # inches: half of a page of two columns
SALT = "splatwizard"  # equal curves make equal files


@dataclass(frozen=True)
class Line:
    """Curve of one method: (megabytes or distance, value, standard deviation over the seeds or None), by the first.

    dash    pattern of the line where it is not `dashed`, any number: for lines of one colour
    """

    name: str
    points: Sequence[tuple[float, float, float | None]]
    style: int
    dashed: bool = False
    dash: int = 0


@dataclass(frozen=True)
class Panel:
    """Curves of one metric.

    x_label     empty: the size of files, on a logarithmic axis
    """

    label: str
    lines: list[Line]
    x_label: str = ""


def write_figures(runs: Sequence[Run], folder: Path) -> list[Path]:
    """Write rd-<scene>.svg and .pdf for every scene and protocol, and rd-<data set> for means over scenes.

    Files with cuts have prefixes-<scene>.svg and .pdf besides, one line each; records that say how far test views lie
    from the training views distance-<scene>.svg and .pdf.

    Nothing is written where no metric has a value. Raises UserInputError without matplotlib; returns the files.
    """
    _check_matplotlib()
    styles = styles_of(runs)
    drawings: dict[str, list[Panel]] = {}
    for place in dict.fromkeys(run.place for run in runs):
        drawings[_free(drawings, place[0])] = _of_scene([run for run in runs if run.place == place], styles)
    for table in dataset_tables(runs):
        drawings[_free(drawings, table.dataset)] = _of_means(table, runs, styles)
    pieces: dict[str, list[Panel]] = {}
    for place in dict.fromkeys(run.place for run in with_prefixes(runs)):
        pieces[_free(pieces, place[0])] = _of_prefixes([run for run in runs if run.place == place], styles)
    far: dict[str, list[Panel]] = {}
    for place in dict.fromkeys(run.place for run in with_distances(runs)):
        far[_free(far, place[0])] = _of_distances([run for run in with_distances(runs) if run.place == place], styles)
    folder.mkdir(parents=True, exist_ok=True)
    return [
        write_panels(panels, folder / f"{kind}-{name}.{form}")
        for kind, named in (("rd", drawings), ("prefixes", pieces), ("distance", far))
        for name, panels in named.items() if panels
        for form in FORMS
    ]  # fmt: skip


def write_panels(panels: Sequence[Panel], path: Path, *, about: str = "") -> Path:
    """Write one figure of panels side by side; equal panels make equal files.

    path    .svg or .pdf
    about   kept in the file's metadata, not shown

    Raises UserInputError without matplotlib; returns the path.
    """
    _check_matplotlib()
    import matplotlib
    from matplotlib.figure import Figure

    form = path.suffix.removeprefix(".")
    undated: dict[str, str | None] = {"Date": None} if form == "svg" else {"CreationDate": None, "ModDate": None}
    if about:
        undated["Description" if form == "svg" else "Subject"] = about
    with matplotlib.rc_context({"svg.hashsalt": SALT, "svg.fonttype": "none", "pdf.fonttype": 42, "font.size": 9}):
        figure = Figure((PANEL[0] * len(panels), PANEL[1]), layout="constrained")
        _draw(figure, panels)
        content = io.BytesIO()
        figure.savefig(content, format=form, metadata=undated)
    write_atomic(path, content.getvalue())
    return path


def _check_matplotlib() -> None:
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        raise UserInputError("--plots needs matplotlib: pip install 'sw-report[plots]'") from None


def _free(taken: dict[str, list[Panel]], title: str) -> str:
    """A file name from a scene or data set, numbered where another has it."""
    name = re.sub(r"[^\w.+-]+", "_", title).strip(".") or "_"
    same = sum(key == name or key.startswith(f"{name}@") for key in taken)
    return f"{name}@{same + 1}" if same else name


def _of_scene(runs: Sequence[Run], styles: dict[str, int]) -> list[Panel]:
    panels = []
    for metric in drawn_metrics(runs):
        lines = []
        for variant in dict.fromkeys(run.variant for run in runs):
            own = [run for run in runs if run.variant == variant]
            points = [(r.size / 1e6, v, r.deviation(metric)) for r in own if (v := r.mean(metric)) is not None]
            lines.append(Line(variant, sorted(points, key=lambda p: p[:2]), styles[variant],
                              any(map(counts_anchors, own))))  # fmt: skip
        panels.append(Panel(numbers.heading(metric), [line for line in lines if line.points]))
    return panels


def _of_prefixes(runs: Sequence[Run], styles: dict[str, int]) -> list[Panel]:
    shown = with_prefixes(runs)
    return [
        Panel(numbers.heading(metric), [
            Line(run.label, points, styles[run.variant])
            for run in shown
            if (points := [(p.bytes / 1e6, p.metrics[metric], None) for p in run.facts.prefixes if metric in p.metrics])
        ])
        for metric in prefix_metrics(shown)
    ]  # fmt: skip


def _of_distances(runs: Sequence[Run], styles: dict[str, int]) -> list[Panel]:
    panels = []
    for metric in drawn_metrics(runs):
        lines = [
            Line(run.label, [(x, y, None) for x, y in found.groups], styles[run.variant],
                 dash=sum(run.variant == other.variant for other in runs[:i]))
            for i, run in enumerate(runs) if (found := reached(run, metric)) is not None
        ]  # fmt: skip
        panels += [Panel(numbers.heading(metric), lines, DISTANCE_LABEL)] if lines else []
    return panels


def _of_means(table: DatasetTable, runs: Sequence[Run], styles: dict[str, int]) -> list[Panel]:
    panels = []
    of_table = [run for run in runs if run.facts.dataset == table.dataset]
    for metric in drawn_metrics(of_table):
        lines = []
        for variant in dict.fromkeys(row.variant for row in table.rows):
            points = [
                (row.size / 1e6, value, row.deviations.get(metric)) for row in table.rows
                if row.variant == variant and row.size is not None and (value := row.metrics.get(metric)) is not None
            ]  # fmt: skip
            dashed = any(counts_anchors(run) for run in of_table if run.variant == variant)
            lines.append(Line(variant, sorted(points, key=lambda p: p[:2]), styles[variant], dashed))
        lines = [line for line in lines if line.points]
        if lines:
            panels.append(Panel(numbers.heading(metric), lines))
    return panels


def _draw(figure: Figure, panels: Sequence[Panel]) -> None:
    from matplotlib.ticker import LogLocator, NullFormatter

    colours = [themes()[0][f"--s{i}"] for i in range(STYLES)]
    handles: dict[str, Any] = {}
    for panel, axes in zip(panels, figure.subplots(1, len(panels), squeeze=False)[0], strict=True):
        for line in panel.lines:
            x, y, deviations = zip(*line.points, strict=True)
            marker = MARKERS[(line.style + line.style // STYLES) % len(MARKERS)]
            style: dict[str, Any] = {
                "color": colours[line.style % STYLES], "marker": marker,
                "markersize": 4.5, "linewidth": 1.3,
                "linestyle": "--" if line.dashed else DASHES[line.dash % len(DASHES)],
            }  # fmt: skip
            (handles[line.name],) = axes.plot(x, y, **style)
            if any(deviation is not None for deviation in deviations):
                axes.errorbar(x, y, [d or 0.0 for d in deviations], fmt="none", ecolor=style["color"], capsize=2)
        if not panel.x_label:
            axes.set_xscale("log")
            # At 1, 2 and 5: what stands between powers of ten by default overlaps where there is one such power.
            axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axes.xaxis.set_major_formatter("{x:g}")
            axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_xlabel(panel.x_label or "file size, MB")
        axes.set_ylabel(_plain(panel.label))
        axes.grid(alpha=0.3, linewidth=0.5)
        axes.spines[["top", "right"]].set_visible(False)
    if len(handles) > 1:
        figure.legend(handles.values(), map(_plain, handles), loc="outside lower center", ncols=4, frameon=False,
                      fontsize=8)  # fmt: skip


def _plain(text: str) -> str:
    """Text that matplotlib does not take for mathematics."""
    return text.replace("$", r"\$")
