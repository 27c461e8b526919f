"""Prefixes of files with cuts: what a part of each file is worth, as tables, charts and rows of a CSV."""

from __future__ import annotations

from collections.abc import Sequence

from sw_report import numbers
from sw_report.blocks import Charts, Figure, Part, Table, columns, row
from sw_report.charts import Chart, Point, Series, swatch
from sw_report.declared import metric_style
from sw_report.distortion import drawn_metrics
from sw_report.runs import Run

HEADING = "Prefixes of the files"


def with_prefixes(runs: Sequence[Run]) -> list[Run]:
    """Runs whose file has cuts that were measured; of several seeds the first one's."""
    return [run for run in runs if run.facts.prefixes]


def prefix_metrics(runs: Sequence[Run]) -> list[str]:
    """Metrics that prefixes have, in the order of the tables."""
    measured = {name for run in runs for prefix in run.facts.prefixes for name in prefix.metrics}
    known = [name for name in drawn_metrics(runs) if name in measured]
    return [*known, *sorted(measured - {*known})]


def prefixes_table(run: Run) -> Table:
    """One row a prefix: packets, bytes, their share of the file, primitives, means over the test views."""
    metrics, whole = prefix_metrics([run]), run.facts.prefixes[-1].bytes
    units = list(run.facts.prefixes[-1].counts)
    rows = [
        row(
            [
                f"{each.packets}", f"{each.bytes:,}", f"{each.bytes / whole:.1%}",
                *(f"{each.counts[unit]:,}" if unit in each.counts else numbers.MISSING for unit in units),
                *(numbers.score(name, each.metrics.get(name)) for name in metrics),
            ],
            emphasis=each is run.facts.prefixes[-1],
        )
        for each in run.facts.prefixes
    ]  # fmt: skip
    heads = ["packets", "bytes", "share", *map(numbers.unit, units), *map(numbers.heading, metrics)]
    return Table(f"Prefixes of {run.label} on {run.facts.scene}", columns(heads), rows)


def prefix_charts(runs: Sequence[Run], style_of: dict[str, int]) -> Charts | None:
    """Quality against bytes, one line a file, one chart a metric; None for files without cuts."""
    shown = with_prefixes(runs)
    dashes = [sum(run.variant == other.variant for other in shown[:i]) for i, run in enumerate(shown)]
    figures = []
    for metric in prefix_metrics(shown):
        style = metric_style(metric)
        lines = [
            Series(
                run.label,
                [
                    Point(each.bytes / 1e6, each.metrics[metric],
                          f"{run.label}, {each.packets} packets: {numbers.score(metric, each.metrics[metric])} "
                          f"{style.unit} at {numbers.megabytes(each.bytes)} MB")
                    for each in run.facts.prefixes if metric in each.metrics
                ],
                style_of[run.variant], dash=dash,
            )
            for run, dash in zip(shown, dashes, strict=True)
        ]  # fmt: skip
        chart = Chart(f"{style.heading} of prefixes", lines, "bytes of the prefix, MB (logarithmic)", x_log=True)
        figures.append(Figure(", ".join(filter(None, (style.label, style.unit))), chart.draw()))
    keys = [(swatch(style_of[run.variant], dash=dash), run.label) for run, dash in zip(shown, dashes, strict=True)]
    return Charts(figures, keys if len(shown) > 1 else []) if figures else None


def prefix_parts(runs: Sequence[Run], style_of: dict[str, int]) -> list[Part]:
    """Curves of the prefixes and their tables; empty for files without cuts."""
    charts = prefix_charts(runs, style_of)
    if charts is None:
        return []
    tables = [prefixes_table(run) for run in with_prefixes(runs)]
    text = "A file with cuts may end after any of its packets, and is then a whole file of a coarser scene."
    return [Part(HEADING, text, charts=charts), *(Part(table=table, folded=table.title) for table in tables)]
