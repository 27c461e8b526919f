"""Metrics against metrics: every decoded file measured by all of them, and how they correlate over the renders."""

from __future__ import annotations

import argparse
import csv
import dataclasses
import hashlib
import itertools
import json
import statistics
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markdown_tables import head, line, number
from protocol_codecs import gsc_folder
from protocol_jobs import Job, run_jobs
from protocol_trainings import black
from sw_report.distance import spearman

LEAST_FILES = 8  # that show a view, for a correlation within it
METRICS = ("psnr", "ssim", "l1", "lpips_vgg_3dgs", "lpips_vgg", "lpips_alex", "cc_psnr", "cc_ssim", "flip", "ms_ssim",
           "haarpsi", "fsim", "vsi", "gmsd", "cvvdp")  # fmt: skip
AGAINST_SOURCE = ("psnr_rgb", "psnr_yuv", "ssim_yuv", "om_psnr_rgb", "om_ssim_yuv")
"""Scores of the protocol against renders of the source model, all higher is better."""

Render = tuple[str, str, str]
"""Scene, view, and file that shows it."""


def run_scores(scenes: Iterable[str], views: Mapping[str, Any], args: argparse.Namespace) -> None:
    """Measure every decoded file, by every metric, on photographs."""
    base = ["--metrics", ",".join(METRICS), "--no-speed", "--quiet", "--json"]
    base += ["--device", args.device] if args.device else []
    base += [word for value in args.set for word in ("--set", value)]
    jobs = []
    for scene in scenes:
        own = ["--scene", str(args.data / scene)]
        own += [word for value in black(args.data, scene) for word in ("--set", value)]
        if views.get(scene, ([], False))[1]:
            listed = args.out / "scores" / f"{scene}-views.json"
            listed.parent.mkdir(parents=True, exist_ok=True)
            listed.write_text(json.dumps({"test": views[scene][0]}))
            own += ["--set", f"split={listed.resolve()}"]
        for file in sorted(gsc_folder(scene, args).glob("*/*/r*.swz")):
            name = f"{file.parent.name} {file.stem}"
            done = args.out / "scores" / "gsc" / scene / file.parent.name / f"{file.stem}.json"
            jobs.append(Job(f"scores {scene} {name}", ("eval", str(file), *own, *base), done, done))
    for folder in [args.out / "train", *args.runs]:
        for record in sorted(folder.rglob("metrics.json")):
            file = record.with_name("scene.swz")
            if file.is_file():
                name = hashlib.sha256(str(record.parent.resolve()).encode()).hexdigest()[:16]
                done = args.out / "scores" / "runs" / f"{name}.json"
                jobs.append(Job(f"scores {record.parent}", ("eval", str(file), *base), done, done))
    print(f"scores: {dict(run_jobs(jobs, args))}")


def renders(
    rows: Iterable[Mapping[str, Any]], args: argparse.Namespace
) -> tuple[dict[Render, dict[str, float]], dict[str, str]]:
    """Values of every render, all turned so that higher is better; and why metrics have none."""
    found: dict[Render, dict[str, float]] = defaultdict(dict)
    absent: dict[str, str] = {}
    scores = args.out / "scores"
    for file in sorted(scores.rglob("*.json")):
        record = json.loads(file.read_bytes())
        if "metrics" not in record:
            continue
        for name in METRICS:
            metric = record["metrics"].get(name)
            if metric is None:
                continue
            if metric["mean"] is None and not any(v is not None for v in metric["per_view"] or []):
                absent[name] = str(record.get("unknown", {}).get(f"metrics.{name}.mean", "not measured"))
                continue
            sign = 1.0 if metric["direction"] == "higher" else -1.0
            for view, value in zip(record["views"], metric["per_view"], strict=True):
                if value is not None:
                    found[record["scene"], view, str(file.relative_to(scores))][name] = sign * value
    for row in rows:
        file = f"gsc/{row['sequence']}/{row['codec']}/{row['rate']}.json"
        for each in row.get("per_view", []):
            values = {f"gsc_{name}": each[name] for name in AGAINST_SOURCE if each[name] is not None}
            if (key := (row["sequence"], each["view"], file)) in found:
                found[key] |= values
    return dict(found), absent


@dataclass(frozen=True)
class Correlation:
    """Of two metrics: over n renders together, and the mean within views; None where there is too little."""

    pearson: float | None
    spearman: float | None
    within_pearson: float | None
    within_spearman: float | None
    n: int
    views: int


def correlate(values: Mapping[Render, Mapping[str, float]], a: str, b: str) -> Correlation:
    """Correlate two metrics over the renders that have both."""
    both = [(key, of[a], of[b]) for key, of in values.items() if a in of and b in of]
    by_view: dict[tuple[str, str], list[tuple[float, float]]] = defaultdict(list)
    for (scene, view, _), x, y in both:
        by_view[scene, view].append((x, y))
    inside = [list(zip(*pairs, strict=True)) for pairs in by_view.values() if len(pairs) >= LEAST_FILES]
    linear = [r for x, y in inside if (r := pearson(x, y)) is not None]
    ranks = [r for x, y in inside if (r := spearman(x, y)) is not None]
    x, y = [each[1] for each in both], [each[2] for each in both]
    few = len(both) < LEAST_FILES
    return Correlation(
        None if few else pearson(x, y), None if few else spearman(x, y), statistics.fmean(linear) if linear else None,
        statistics.fmean(ranks) if ranks else None, len(both), len(ranks),
    )  # fmt: skip


def pearson(a: Sequence[float], b: Sequence[float]) -> float | None:
    """Linear correlation in -1..1; None where one is constant."""
    x, y = (np.asarray(each, dtype=np.float64) for each in (a, b))
    x, y = x - x.mean(), y - y.mean()
    norm = float(np.sqrt((x @ x) * (y @ y)))
    return None if norm == 0 else float(x @ y) / norm


def correlation_section(rows: Sequence[dict[str, Any]], args: argparse.Namespace) -> list[str]:
    """Metrics against metrics: two squares, Spearman below the diagonal and Pearson above it."""
    values, absent = renders(rows, args)
    if not values:
        return []
    names = [name for name in (*METRICS, *(f"gsc_{each}" for each in AGAINST_SOURCE))
             if any(name in of for of in values.values())]  # fmt: skip
    pairs = {(a, b): correlate(values, a, b) for a, b in itertools.combinations(names, 2)}
    with (args.out / "correlations.csv").open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["a", "b", *(field.name for field in dataclasses.fields(Correlation))])
        for (a, b), found in pairs.items():
            writer.writerow([a, b, *("" if v is None else v for v in dataclasses.astuple(found))])
    scenes = Counter(scene for scene, _, _ in values)
    told = ", ".join(f"{scene} {n:,}" for scene, n in sorted(scenes.items()))
    files = len({file for _, _, file in values})
    lines = [
        "## Metrics against metrics",
        "",
        f"{len(values):,} renders of {files} file{'s' * (files != 1)}: {told}.",
        "",
    ]
    absences = [f"`{name}` ({why.partition(':')[0]})" for name, why in absent.items() if name not in names]
    lines += [f"Not available: {'; '.join(absences)}.", ""] if absences else []
    for title, above, below in (
        ("All renders together", "pearson", "spearman"),
        (f"Within views that at least {LEAST_FILES} files show, mean", "within_pearson", "within_spearman"),
    ):
        lines += [f"### {title}: Pearson above the diagonal, Spearman below", "", *head(["", *names])]
        for i, a in enumerate(names):
            cells = []
            for j, b in enumerate(names):
                found = pairs.get((a, b)) if i < j else pairs.get((b, a))
                cells.append("" if found is None else number(getattr(found, above if i < j else below)))
            lines.append(line([f"`{a}`", *cells]))
        lines.append("")
    return lines
