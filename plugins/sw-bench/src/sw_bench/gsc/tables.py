"""Means, BD-rates and the two CSV files of the protocol."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any

from splatwizard_core.api import UserInputError
from sw_bench.gsc.scores import psnr

PARTS = ("position", "sh0", "sh1", "sh2", "sh3", "rotation", "scaling", "opacity", "metadata")
COLUMNS = (
    "sequence", "codec", "rate", "protocol", "frames", "views", "splats_source", "splats_decoded", "bytes",
    "bits_per_splat", *(f"bytes_{part}" for part in PARTS), "kbps",
    "psnr_rgb", "psnr_rgb_min", "psnr_rgb_max", "psnr_rgb_pooled", "psnr_yuv", "psnr_yuv_min", "psnr_yuv_max",
    "ssim_yuv", "ssim_yuv_min", "ssim_yuv_max", "om_psnr_rgb", "om_ssim_yuv", "occupancy", "infinite_views",
    "enc_s", "dec_s", "rss_enc_mb", "rss_dec_mb", "flags",
)  # fmt: skip
"""Columns of gsc.csv."""
QUALITIES = ("psnr_rgb", "psnr_yuv", "ssim_yuv")
"""Qualities that BD-rates are stated on."""
BD_COLUMNS = (
    "sequence", "codec", "anchor", *(f"bd_{name}" for name in QUALITIES), *(f"overlap_{name}" for name in QUALITIES),
    "note",
)  # fmt: skip
"""Columns of gsc_bd.csv."""
FEWEST_POINTS = 4
MEAN = "mean"

Row = dict[str, Any]


def summary(scores: Sequence[Mapping[str, Any]]) -> Row:
    """Mean, smallest and largest of views' scores. A PSNR is over the views whose pictures differ."""
    found: Row = {"views": len(scores), "infinite_views": sum(each["psnr_rgb"] is None for each in scores)}
    for name in QUALITIES:
        values = [each[name] for each in scores if each[name] is not None]
        found[name] = _mean(values)
        found[f"{name}_min"], found[f"{name}_max"] = (min(values), max(values)) if values else (None, None)
    for name in ("om_psnr_rgb", "om_ssim_yuv", "occupancy"):
        found[name] = _mean([each[name] for each in scores if each[name] is not None])
    for name in ("rgb", "yuv"):
        found[f"psnr_{name}_pooled"] = pooled([each[f"mse_{name}"] for each in scores])
    return found


def pooled(mses: Sequence[float]) -> float | None:
    """PSNR in dB of the mean over views of the mean squared error; None where all views are equal."""
    return psnr(sum(mses) / len(mses))


def parts_of(sections: Mapping[str, int], size: int) -> dict[str, int | None]:
    """Bytes by attribute, where the sections of a file are attributes; else None for each. They sum to `size`."""
    named = {part: sections.get(part, 0) for part in PARTS if part != "metadata"}
    if not sections.get("position") or not sections.get("sh0") or set(sections) - {*named, "header"}:
        return {f"bytes_{part}": None for part in PARTS}
    return {**{f"bytes_{part}": n for part, n in named.items()}, "bytes_metadata": size - sum(named.values())}


def bd_rows(rows: Sequence[Row], anchor: str) -> list[Row]:
    """BD-rates of every codec against the anchor, scene by scene, then the mean over the scenes that have one.

    Where a codec has views without a PSNR, PSNRs are of the pooled error, for all codecs. Points where every view is
    equal are left out, and said.
    """
    found: list[Row] = []
    sequences = sorted({row["sequence"] for row in rows})
    codecs = sorted({row["codec"] for row in rows} - {anchor})
    for codec in codecs:
        all_scenes = (_bd(rows, sequence, codec, anchor) for sequence in sequences)
        of_codec = [row for row in all_scenes if row is not None]
        if not of_codec:
            continue
        mean: Row = {"sequence": MEAN, "codec": codec, "anchor": anchor}
        had = []
        for name in QUALITIES:
            values = [row[f"bd_{name}"] for row in of_codec if row[f"bd_{name}"] is not None]
            mean[f"bd_{name}"] = _mean(values)
            mean[f"overlap_{name}"] = None
            had.append(f"{name} {len(values)} of {len(of_codec)}")
        found += [*of_codec, {**mean, "note": "scenes: " + ", ".join(had)}]
    return found


def _bd(rows: Sequence[Row], sequence: str, codec: str, anchor: str) -> Row | None:
    from sw_report.rate_distortion import bd_rate

    of_scene = [row for row in rows if row["sequence"] == sequence and row["bytes"] is not None]
    curves = {name: [row for row in of_scene if row["codec"] == name] for name in (anchor, codec)}
    if len(curves[codec]) < FEWEST_POINTS:  # a codec without a dial has no curve
        return None
    found: Row = {"sequence": sequence, "codec": codec, "anchor": anchor}
    notes = []
    is_pooled = any(row["infinite_views"] for row in of_scene)
    if is_pooled:
        notes.append("pooled PSNR")
    for name in QUALITIES:
        key = f"{name}_pooled" if is_pooled and name != "ssim_yuv" else name
        points = {who: [(row["bytes"], row[key]) for row in curve if row[key] is not None]
                  for who, curve in curves.items()}  # fmt: skip
        notes += [f"{name}: {len(curves[who]) - len(each)} points of {who} without a value"
                  for who, each in points.items() if len(each) < len(curves[who])]  # fmt: skip
        value, overlap = None, None
        if min(len(each) for each in points.values()) < FEWEST_POINTS:
            notes.append(f"{name}: fewer than {FEWEST_POINTS} points")
        else:
            try:
                ours, theirs = (([x for x, _ in points[who]], [y for _, y in points[who]]) for who in (anchor, codec))
                result = bd_rate(ours, theirs, names=(anchor, codec), metric=name)
                value, overlap = result.value, result.overlap
                notes += [f"{name}: {flag}" for flag in result.flags]
            except UserInputError as error:
                notes.append(f"{name}: {str(error).partition(': ')[2].partition(':')[0]}")
        found[f"bd_{name}"], found[f"overlap_{name}"] = value, overlap
    return {**found, "note": "; ".join(dict.fromkeys(notes))}


def csv_text(columns: Sequence[str], rows: Sequence[Row]) -> str:
    """Lines of a CSV; what is not known is empty, and no text begins like a formula."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    for row in rows:
        writer.writerow([_cell(row.get(name)) for name in columns])
    return text.getvalue()


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:.6f}".rstrip("0").rstrip(".") or "0"
    text = str(value)
    return f"'{text}" if isinstance(value, str) and text[:1] in ("=", "+", "-", "@", "\t") else text


def _mean(values: Sequence[float]) -> float | None:
    return sum(values) / len(values) if values else None
