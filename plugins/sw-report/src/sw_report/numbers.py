"""Spelling of numbers and metric names, the same in every kind of report."""

from __future__ import annotations

import math
from collections.abc import Iterable

from sw_report.declared import metric_key, metric_style

MISSING = "–"
MACHINES = "ᵃᵇᶜᵈᵉᶠᵍʰ"
"""Marks of values that come from different machines; later ones share the last."""
FLOAT32_NOTE = "as float32, {} would take about {} MB."
PLUS_MINUS = "±"
SEEDS_NOTE = "± standard deviation over the seeds (of the sample, n - 1); the value is their mean."
UNCOMPRESSED_NOTE = "{}: the parameters as they were trained, not compressed."
SHARED = "†"
SHARED_NOTE = f"{SHARED} Other processes wanted the cores meanwhile: on an idle machine it is faster."
FIELD_LPIPS = "lpips_vgg_3dgs"  # the form that the field's tables, the survey's among them, print


def ordered_metrics(names: Iterable[str]) -> list[str]:
    """Metric names without repetition, by the positions that they declare; those without one last, by name."""
    return sorted(dict.fromkeys(names), key=lambda name: (metric_style(name).position, name))


def order_after_run(metric: str) -> float:
    """Place of a metric in the table that `sw run` prints: further forms of LPIPS have none, like unknown metrics."""
    further = is_lpips(metric) and metric_key(metric) != FIELD_LPIPS
    return math.inf if further else metric_style(metric).position


def is_lpips(metric: str) -> bool:
    """Whether a metric is a form of LPIPS, which are never compared with each other."""
    return metric_key(metric).startswith("lpips")


def main_lpips(names: Iterable[str]) -> str | None:
    """Name of the LPIPS that tables of the field use, else of the first that is there; None without any."""
    return next((name for name in ordered_metrics(names) if is_lpips(name)), None)


def heading(metric: str) -> str:
    """A metric with its unit, as the head of a column."""
    return metric_style(metric).heading


def score(metric: str, value: float | None, *, digits: int | None = None) -> str:
    """A value of a metric, with as many decimals as the metric declares unless told otherwise."""
    if value is None:
        return MISSING
    return f"{value:.{metric_style(metric).digits if digits is None else digits}f}"


def with_deviation(text: str, deviation: str | None) -> str:
    """A mean over seeds and its standard deviation: `27.20 ± 0.05`; the value alone where there is none."""
    return text if deviation is None else f"{text} ± {deviation}"


def megabytes(size: float | None) -> str:
    """10^6 bytes, three significant digits or so."""
    if size is None:
        return MISSING
    mega = size / 1e6
    return f"{mega:,.1f}" if mega >= 100 else f"{mega:.2f}" if mega >= 10 else f"{mega:.3f}"


def seconds(value: float | None) -> str:
    """Seconds without their unit, three significant digits or so."""
    if value is None:
        return MISSING
    return f"{value:,.0f}" if value >= 100 else f"{value:.1f}" if value >= 10 else f"{value:.2f}"


def count(value: float | None) -> str:
    """A whole number with separators."""
    return MISSING if value is None else f"{value:,.0f}"


def counts(values: dict[str, int]) -> str:
    """`242,118` or, for anchors, `24,000 anchors / 240,000`."""
    found = [f"{n:,}" if name == "num_gaussians" else f"{n:,} {unit(name)}" for name, n in values.items()]
    return " / ".join(found) or MISSING


def unit(name: str) -> str:
    """`num_gaussians` -> `Gaussians`."""
    word = name.removeprefix("num_").replace("_", " ")
    return "Gaussians" if word == "gaussians" else word


def rate(value: float | None) -> str:
    """Frames per second."""
    if value is None:
        return MISSING
    return f"{value:,.0f}" if value >= 100 else f"{value:.1f}"


def shared(text: str, contended: bool) -> str:
    """A time or a rate, marked if other processes wanted the cores while it was measured."""
    return text + SHARED if contended else text


def percent(value: float | None) -> str:
    """A percentage without its sign: one decimal, plus or a real minus before it."""
    return MISSING if value is None else f"{value:+.1f}".replace("-", "−")


def signed(value: float | None, digits: int = 2) -> str:
    """A difference, with a real minus sign."""
    return MISSING if value is None else f"{value:+.{digits}f}".replace("-", "−")
