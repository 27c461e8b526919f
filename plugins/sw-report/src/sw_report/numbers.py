"""How numbers and metric names are written, the same in every kind of report."""

from __future__ import annotations

from collections.abc import Iterable

MISSING = "–"
FIELD_LPIPS = "lpips_vgg_3dgs"  # the form that the field's tables, the survey's among them, print
_ORDER = ("psnr", "ssim", FIELD_LPIPS, "lpips_vgg", "lpips_alex", "l1")
_HEADINGS = {
    "psnr": "PSNR dB",
    "ssim": "SSIM",
    "l1": "L1",
    "lpips_vgg_3dgs": "LPIPS (VGG, 3DGS)",
    "lpips_vgg": "LPIPS (VGG)",
    "lpips_alex": "LPIPS (Alex)",
}


def _key(metric: str) -> str:
    return metric.lower().replace("-", "_")


def ordered_metrics(names: Iterable[str]) -> list[str]:
    """Metric names without repetition, the field's usual ones first."""
    return sorted(dict.fromkeys(names), key=lambda n: (_ORDER.index(_key(n)) if _key(n) in _ORDER else 99, n))


def main_lpips(names: Iterable[str]) -> str | None:
    """The LPIPS that tables of the field use, or whichever is there."""
    found = [name for name in ordered_metrics(names) if _key(name).startswith("lpips")]
    return found[0] if found else None


def heading(metric: str) -> str:
    return _HEADINGS.get(_key(metric), metric)


def score(metric: str, value: float | None, *, digits: int | None = None) -> str:
    """A value of a metric: decibels with 2 decimals, the others with 4."""
    if value is None:
        return MISSING
    decibel = "psnr" in _key(metric)
    return f"{value:.{(2 if decibel else 4) if digits is None else digits}f}"


def megabytes(size: float | None) -> str:
    """10^6 bytes, three significant digits or so."""
    if size is None:
        return MISSING
    mega = size / 1e6
    return f"{mega:,.1f}" if mega >= 100 else f"{mega:.2f}" if mega >= 10 else f"{mega:.3f}"


def seconds(value: float | None) -> str:
    if value is None:
        return MISSING
    return f"{value:,.0f}" if value >= 100 else f"{value:.1f}" if value >= 10 else f"{value:.2f}"


def count(value: float | None) -> str:
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


def percent(value: float | None) -> str:
    """Signed, one decimal, with a real minus sign."""
    return MISSING if value is None else f"{value:+.1f}".replace("-", "−")


def signed(value: float | None, digits: int = 2) -> str:
    return MISSING if value is None else f"{value:+.{digits}f}".replace("-", "−")
