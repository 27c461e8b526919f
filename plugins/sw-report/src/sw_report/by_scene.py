"""Quality scene by scene: one chart a metric, a mark for each run, so that no mean hides where a method is weak."""

from __future__ import annotations

from collections.abc import Sequence

from sw_report import numbers
from sw_report.blocks import Charts, Figure
from sw_report.charts import Chart, Point, Series, swatch
from sw_report.declared import metric_style
from sw_report.distortion import drawn_metrics
from sw_report.runs import Run, natural

MOST_SCENES = 16  # whose names have room below a chart
LONGEST_NAME = 40  # characters of all names below a chart; beyond, numbers stand there


def scene_charts(runs: Sequence[Run], style_of: dict[str, int]) -> Charts | None:
    """Every run's value by scene, one chart a metric; None for fewer than two scenes, or more than fit."""
    scenes = sorted({run.facts.scene for run in runs}, key=natural)
    if not 2 <= len(scenes) <= MOST_SCENES:
        return None
    short = sum(map(len, scenes)) <= LONGEST_NAME
    stops = [(float(i), name if short else str(i + 1)) for i, name in enumerate(scenes)]
    figures = []
    for metric in drawn_metrics(runs):
        style = metric_style(metric)
        lines = []
        for variant in dict.fromkeys(run.variant for run in runs):
            points = [
                Point(float(scenes.index(run.facts.scene)), value,
                      f"{run.label} on {run.facts.scene}: {numbers.score(metric, value)} {style.unit}".rstrip())
                for run in runs if run.variant == variant and (value := run.mean(metric)) is not None
            ]  # fmt: skip
            lines.append(Series(variant, points, style_of[variant], joined=False))
        if any(line.points for line in lines):
            chart = Chart(f"{style.heading} scene by scene", lines, "scene", stops=stops)
            lower = any(r.facts.metrics[metric].direction == "lower" for r in runs if metric in r.facts.metrics)
            caption = ", ".join(filter(None, (style.label, style.unit)))
            figures.append(Figure(f"{caption}{' (lower is better)' if lower else ''}", chart.draw()))
    if not figures:
        return None
    variants = list(dict.fromkeys(run.variant for run in runs))
    notes = [] if short else [", ".join(f"{i + 1} {name}" for i, name in enumerate(scenes)) + "."]
    notes.append("A mark for each rate point.")
    return Charts(figures, [(swatch(style_of[v]), v) for v in variants] if len(variants) > 1 else [], notes)
