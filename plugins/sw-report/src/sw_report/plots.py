"""Charts of a report: rate and distortion, bytes by section, training, scores view by view."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from sw_report import numbers
from sw_report.aggregate import DatasetTable
from sw_report.blocks import Cell, Charts, Figure, Table, columns, row
from sw_report.charts import STYLES, Bar, Chart, Point, Series, square, stacked_bars, swatch
from sw_report.declared import MetricStyle, metric_style
from sw_report.distortion import drawn_metrics
from sw_report.pictures import pick_evenly
from sw_report.results_tables import metric_names
from sw_report.runs import Run
from sw_report.training_log import TrainingCurves, log_path, read_training

MOST_SECTIONS = 2 * STYLES - 1  # with a colour of their own; smaller ones are joined
MOST_LINES = 8
MOST_LABELLED = 16  # points of a chart with their rate points beside them
MOST_VIEWS_IN_TABLE = 300
MOST_BARS = 24


def variants_of(runs: Sequence[Run]) -> list[str]:
    """Names of the methods, in the order of the runs."""
    return list(dict.fromkeys(run.variant for run in runs))


def counts_anchors(run: Run) -> bool:
    """Whether a run stores anchors, whose number is not comparable with Gaussians: its line is dashed."""
    return "num_anchors" in run.facts.counts


def distortion_charts(runs: Sequence[Run], style_of: dict[str, int]) -> Charts | None:
    """Quality against bytes, one chart per metric, one line per method."""
    variants = variants_of(runs)
    figures = []
    for metric in drawn_metrics(runs):
        style = metric_style(metric)
        lines = []
        for variant in variants:
            own = sorted((r for r in runs if r.variant == variant), key=lambda r: r.size)
            points = [
                Point(
                    run.size / 1e6,
                    value,
                    f"{run.label}: {f'{numbers.score(metric, value)} {style.unit}'.strip()} at "
                    f"{' '.join((numbers.megabytes(run.size), 'MB', run.facts.uncompressed())).strip()}",
                    run.facts.rate or "" if len(runs) <= MOST_LABELLED else "",
                )
                for run in own
                if (value := run.mean(metric)) is not None
            ]
            dashed = any(counts_anchors(run) for run in own)
            lines.append(Series(variant, points, style_of[variant], dashed))
        lower = any(run.facts.metrics[metric].direction == "lower" for run in runs if metric in run.facts.metrics)
        title = f"{style.heading} against file size for {', '.join(variants)}"
        chart = Chart(title, lines, "file size, MB (logarithmic)", x_log=True)
        figures.append(Figure(f"{_caption(style)}{' (lower is better)' if lower else ''}", chart.draw()))
    if not figures:
        return None
    legend = [(swatch(style_of[v], dashed=any(counts_anchors(r) for r in runs if r.variant == v)), v) for v in variants]
    notes = ["Dashed: anchors, not Gaussians, are stored."] if any(map(counts_anchors, runs)) else []
    return Charts(figures, legend if len(variants) > 1 else [], notes)


def mean_charts(table: DatasetTable, runs: Sequence[Run], style_of: dict[str, int]) -> Charts | None:
    """Mean quality against mean bytes over the scenes of a data set; None if no method has a curve.

    runs    those that the means are of
    """
    figures = []
    rows = [row for row in table.rows if row.size is not None]
    variants = list(dict.fromkeys(row.variant for row in rows))
    dashed = {v: any(counts_anchors(run) for run in runs if run.variant == v) for v in variants}
    for metric in drawn_metrics(runs):
        style = metric_style(metric)
        lines = []
        for variant in variants:
            points = [
                Point(size / 1e6, value, f"{variant} {row.rate or ''}: {numbers.score(metric, value)} {style.unit} at "
                      f"{numbers.megabytes(size)} MB", row.rate or "" if len(rows) <= MOST_LABELLED else "")
                for row in sorted(rows, key=lambda row: row.size or 0.0)
                if row.variant == variant and (size := row.size) and (value := row.metrics.get(metric)) is not None
            ]  # fmt: skip
            lines.append(Series(variant, points, style_of[variant], dashed[variant]))
        if any(len(line.points) > 1 for line in lines):
            chart = Chart(
                f"Mean {style.heading} over {table.title}", lines, "mean file size, MB (logarithmic)", x_log=True
            )
            better = " (lower is better)" if table.directions.get(metric) == "lower" else ""
            figures.append(Figure(f"{_caption(style)}{better}", chart.draw()))
    if not figures:
        return None
    legend = [(swatch(style_of[v], dashed=dashed[v]), v) for v in variants] if len(variants) > 1 else []
    notes = ["Dashed: anchors, not Gaussians, are stored."] if any(dashed.values()) else []
    return Charts(figures, legend, notes)


def _caption(style: MetricStyle) -> str:
    return ", ".join(filter(None, (style.label, style.unit)))


def section_styles(runs: Sequence[Run]) -> dict[str, int]:
    """A colour for each section, the largest first."""
    totals: dict[str, int] = {}
    for run in runs:
        for name, size in run.facts.file.sections.items():
            totals[name] = totals.get(name, 0) + size
    ordered = sorted(totals, key=lambda name: -totals[name])
    return {name: min(i, MOST_SECTIONS) for i, name in enumerate(ordered)}


def section_bars(runs: Sequence[Run]) -> Charts | None:
    """Bytes by section as one stacked bar a run."""
    with_sections = [run for run in runs if run.facts.file.sections]
    if not with_sections:
        return None
    shown = pick_evenly(with_sections, MOST_BARS)
    styles = section_styles(shown)
    bars = []
    for run in shown:
        sections = sorted(run.facts.file.sections.items(), key=lambda item: styles[item[0]])
        size = run.facts.file.bytes
        parts = [(styles[n], b / size, f"{n}: {b:,} bytes, {b / size:.1%}") for n, b in sections]
        bars.append(Bar(run.label, f"{numbers.megabytes(size)} MB", parts))
    legend = [(square(style), name) for name, style in styles.items() if style < MOST_SECTIONS]
    if len(styles) > MOST_SECTIONS:
        smaller = [name for name, style in styles.items() if style == MOST_SECTIONS]
        legend.append((square(MOST_SECTIONS), f"smaller: {', '.join(smaller)}"))
    svg = stacked_bars(f"Bytes by section for {len(shown)} runs", bars)
    notes = [f"{len(shown)} of {len(with_sections)} runs, spread evenly."] if len(shown) < len(with_sections) else []
    if len(with_sections) < len(runs):
        notes.append(f"{len(runs) - len(with_sections)} records list no sections.")
    return Charts(
        [Figure("Share of the file that each section takes; the bytes of the file at the right", svg)], legend, notes
    )


def sections_table(runs: Sequence[Run]) -> Table | None:
    """Bytes by section, one column a run."""
    styles = section_styles(runs)
    if not styles:
        return None
    heads = ["section", *(run.label for run in runs)]
    rows = [
        row([name, *(f"{run.facts.file.sections[name]:,}" if name in run.facts.file.sections else numbers.MISSING
                     for run in runs)])
        for name in styles
    ]  # fmt: skip
    rows.append(row(["file", *(f"{run.facts.file.bytes:,}" for run in runs)], emphasis=True))
    return Table("Bytes by section", columns(heads), rows)


def single_sections_table(run: Run) -> Table | None:
    """Bytes by section of one file, with bars."""
    styles, size = section_styles([run]), run.facts.file.bytes
    if not styles:
        return None
    largest = max(run.facts.file.sections.values()) or 1
    rows = [
        row([name, f"{b:,}", f"{b / size:.1%}", Cell("", share=b / largest, style=0)])
        for name, b in sorted(run.facts.file.sections.items(), key=lambda item: styles[item[0]])
    ]
    rows.append(row(["file", f"{size:,}", "100.0%", ""], emphasis=True))
    notes = []
    total = sum(run.facts.file.sections.values())
    if total != size:
        notes.append(f"The sections sum to {total:,} bytes, the file has {size:,}.")
    return Table("Bytes by section", columns(["section", "bytes", "share", ""]), rows, notes=notes, wide=True)


@dataclass(frozen=True)
class Drawn:
    """One training as the charts draw it; `style` and `dash` as of `charts.Series`.

    contended   other processes wanted the cores meanwhile
    """

    name: str
    curves: TrainingCurves
    style: int
    dash: int
    contended: bool = False


def training_charts(runs: Sequence[Run], style_of: dict[str, int]) -> tuple[Charts | None, list[str]]:
    """Loss, counts and curves of tasks over the steps, one line for each different training; and what is missing.

    Trainings of one method have its colour and patterns of their own.
    """
    trainings: dict[object, list[Run]] = {}
    for run in runs:
        trainings.setdefault(log_path(run), []).append(run)
    curves: list[Drawn] = []
    missing: dict[str, list[str]] = {}
    for path, group in trainings.items():
        found = read_training(path)  # type: ignore[arg-type]
        if found.missing is not None:
            missing.setdefault(found.missing, []).append(group[0].label)
            continue
        rates = [run.facts.rate for run in group if run.facts.rate]
        name = group[0].variant + (f" ({', '.join(rates)})" if rates and len(runs) > 1 else "")
        variant = group[0].variant
        dash, contended = sum(style_of[variant] == c.style for c in curves), any(r.contended("train") for r in group)
        curves.append(Drawn(name, found, style_of[variant], dash, contended))
    notes = [f"{', '.join(names)}: {why}" for why, names in missing.items()]
    if len(curves) > MOST_LINES:
        notes.append(f"{MOST_LINES} of {len(curves)} trainings are drawn")
        curves = curves[:MOST_LINES]
    if not curves:
        return None, notes
    figures = _training_figures(curves)
    damaged = sum(c.curves.damaged for c in curves)
    if damaged:
        notes.append(f"{damaged} damaged lines of logs were passed over")
    legend = [(swatch(c.style, marks=False, dash=c.dash), c.name) for c in curves] if len(curves) > 1 else []
    return Charts(figures, legend), notes


def _training_figures(drawn: Sequence[Drawn]) -> list[Figure]:
    stages = drawn[0].curves.stages if len(drawn) == 1 else []
    borders = [(float(step), f"stage {index + 1}") for step, index in stages[1:]]
    figures = []

    def add(caption: str, title: str, pick: Callable[[TrainingCurves], Sequence[tuple[float, float]]],
            *, log: bool = False, over: str = "step") -> None:  # fmt: skip
        lines = [
            Series(d.name, [Point(x, y) for x, y in pick(d.curves) if y > 0 or not log], d.style, marks=False,
                   dash=d.dash)
            for d in drawn
        ]  # fmt: skip
        within = borders if over == "step" else []
        if any(len(s.points) > 1 for s in lines):
            figures.append(Figure(caption, Chart(title, lines, over, y_log=log, borders=within).draw()))

    add("Training loss (logarithmic, means of neighbouring steps)", "Training loss over steps", lambda c: c.loss,
        log=True)  # fmt: skip
    shared = f". {numbers.SHARED_NOTE}" if any(d.contended and d.curves.quality for d in drawn) else ""
    for name in sorted({name for d in drawn for name in d.curves.quality}, key=lambda name: (name != "psnr", name)):
        style = metric_style(name)
        add(f"{style.label} of the test views over seconds of training, evaluation not counted{shared}",
            f"{style.heading} over seconds of training", lambda c, name=name: c.quality.get(name, []),  # type: ignore[misc]
            over="seconds of training")  # fmt: skip
    counted = {key for d in drawn for key in d.curves.counts}
    for key in sorted(counted, key=lambda key: (key != "num_gaussians", key)):
        caption = f"Number of {numbers.unit(key)}"
        add(caption, f"{caption} over steps", lambda c, key=key: c.counts.get(key, []))  # type: ignore[misc]
    for name in dict.fromkeys(name for d in drawn for name in d.curves.scalars):
        add(name, f"{name} over steps", lambda c, name=name: c.scalars.get(name, []))  # type: ignore[misc]
    return figures


def view_charts(runs: Sequence[Run], style_of: dict[str, int]) -> Charts | None:
    """First two metrics (PSNR and SSIM) of every test view; views in the order of the record."""
    shown = pick_evenly(runs, MOST_LINES)
    styles = [
        (style_of[r.variant], sum(r.variant == other.variant for other in shown[:i])) for i, r in enumerate(shown)
    ]
    figures = []
    for metric in drawn_metrics(shown)[:2]:
        lines = []
        for run, (style, dash) in zip(shown, styles, strict=True):
            scores = run.facts.metrics[metric].per_view if metric in run.facts.metrics else []
            points = [
                Point(float(j + 1), value, f"{run.label}, {name}: {numbers.score(metric, value, digits=3)}")
                for j, (name, value) in enumerate(zip(run.facts.views, scores, strict=False))
                if value is not None
            ]
            lines.append(Series(run.label, points, style, joined=len(shown) > 1, dash=dash))
        if not any(line.points for line in lines):
            continue
        average = shown[0].mean(metric) if len(shown) == 1 else None
        levels = [(average, f"mean {numbers.score(metric, average)}")] if average is not None else []
        style = metric_style(metric)
        chart = Chart(f"{style.heading} of every test view", lines, "test view", levels=levels)
        figures.append(Figure(_caption(style), chart.draw()))
    if not figures:
        return None
    keys = [swatch(style, dash=dash) for style, dash in styles]
    legend = [(key, run.label) for key, run in zip(keys, shown, strict=True)] if len(shown) > 1 else []
    notes = [f"{len(shown)} of {len(runs)} runs, spread evenly."] if len(shown) < len(runs) else []
    return Charts(figures, legend, notes)


def views_table(runs: Sequence[Run]) -> Table | None:
    """Scores view by view: all metrics of one run, or the PSNR of several."""
    first = runs[0]
    if not first.facts.views:
        return None
    shown = pick_evenly(runs, MOST_BARS)
    if len(runs) == 1:
        names = [n for n in metric_names(runs) if first.facts.metrics[n].per_view]
        parts = [(numbers.heading(n), n, first) for n in names]
    else:
        parts = [(run.label, "psnr", run) for run in shown if "psnr" in run.facts.metrics]
    rows = []
    for view in first.facts.views[:MOST_VIEWS_IN_TABLE]:
        values = []
        for _, metric, run in parts:
            scores = run.facts.metrics[metric].per_view
            j = run.facts.views.index(view) if view in run.facts.views else len(scores)
            values.append(numbers.score(metric, scores[j] if j < len(scores) else None, digits=None))
        rows.append(row([view, *values]))
    notes = []
    if len(first.facts.views) > MOST_VIEWS_IN_TABLE:
        notes.append(f"The first {MOST_VIEWS_IN_TABLE} of {len(first.facts.views)} views.")
    if any(v is None for _, m, run in parts for v in run.facts.metrics[m].per_view[: len(run.facts.views)]):
        notes.append("A dash: the value is infinite, since render and photograph are identical.")
    caption = "" if len(runs) == 1 else "PSNR in dB."
    return Table("Scores of every view", columns(["view", *(name for name, _, _ in parts)]), rows, caption, notes)
