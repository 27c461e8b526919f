"""Scores by how views are held out: every 8th against a sector, and by the distance from the training views."""

from __future__ import annotations

import argparse
import contextlib
import csv
import json
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from markdown_tables import head, line, number
from protocol_trainings import SECTOR, SPLIT_METHODS, SPLIT_SCENE
from sw_report.blocks import Table
from sw_report.distance import EXPLAINED, HEADING, NEAR_TO_FAR, distance_table, reached, with_distances
from sw_report.exports import to_markdown
from sw_report.figures import write_figures
from sw_report.runs import collect
from sweep_cells import Cell

from splatwizard_core.api import UserInputError

RECORDS = Path(__file__).resolve().parents[1] / "docs" / "records"
SPLIT_METRICS = ("psnr", "ssim", "lpips_vgg_3dgs")
SPLIT_COLUMNS = ("method", "rate", "metric", "every8", "every8_in_sector", "sector", "fall", "views_every8",
                 "views_sector", "protocol_every8", "protocol_sector", "steps_every8", "steps_sector")  # fmt: skip


def split_section(args: argparse.Namespace) -> list[str]:
    """Every 8th view against a sector: means over the held-out views, and the fall.

    Where a method lacks the first, the project's record of the full plan stands for it, which its steps say. A row of
    OUT/splits.csv whose records are not there any more stays.
    """
    lines, table, ids = [], [], set()
    written = args.out / "splits.csv"
    earlier = list(csv.DictReader(written.open(newline=""))) if written.is_file() else []
    for method, rate, _ in SPLIT_METHODS:
        cells = [Cell(label, method, str(args.data / SPLIT_SCENE), rate) for label in (method, f"{method}-sector")]
        files = [cell.directory(args.out / "train") / "metrics.json" for cell in cells]
        if not files[1].is_file():
            for row in earlier:
                if row["method"] == method:
                    told = [row[key] for key in SPLIT_COLUMNS[7:11]]
                    ids.add((int(told[0]), int(told[1]), *told[2:]))
                    means = [float(row[key]) if row[key] else None for key in SPLIT_COLUMNS[3:7]]
                    steps = [int(row[key]) if row.get(key) else None for key in SPLIT_COLUMNS[11:]]
                    table.append([method, rate, row["metric"], *means, *told, *steps])
            continue
        far = json.loads(files[1].read_bytes())
        near = json.loads(files[0].read_bytes()) if files[0].is_file() else None
        kept = None if near is not None else recorded(method, rate)
        for name in SPLIT_METRICS:
            if near is not None:
                means = [mean_of(near, name), mean_of(near, name, set(far["views"])), mean_of(far, name)]
                views, protocol, steps = near["test_views"], near["protocol"]["id"], near["train"]["steps"]
            elif kept is not None:
                means = [kept.get(name), None, mean_of(far, name)]
                views, protocol, steps = kept["test_views"], kept["protocol"], kept["steps"]
            else:
                continue
            if means[0] is None:
                continue
            told = [views, far["test_views"], protocol, far["protocol"]["id"]]
            ids.add(tuple(told))
            fall = None if means[2] is None else means[0] - means[2]
            table.append([method, rate, name, *means, fall, *told, steps, far["train"]["steps"]])
    with written.open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(
            [SPLIT_COLUMNS, *([("" if v is None else v) for v in r] for r in table)]
        )
    if not table:
        return []
    lines += [f"## Every 8th view against `{SECTOR}` on {SPLIT_SCENE}", ""]
    for first, second, near_id, far_id in sorted(ids):
        lines += [f"`{near_id}` ({first} views held out) and `{far_id}` ({second} views)", ""]
    lines += head(["method", "rate", "metric", "every8", "every8, views inside the sector", "sector", "fall", "steps"])
    for row in table:
        near_steps, far_steps = ("-" if n is None else f"{n:,}" for n in row[11:13])
        steps = near_steps if near_steps == far_steps else f"{near_steps}, sector {far_steps}"
        lines.append(line([*row[:3], *(number(v, 2 if row[2] == "psnr" else 4) for v in row[3:7]), steps]))
    return [*lines, ""]


def recorded(method: str, rate: str) -> dict[str, Any] | None:
    """The project's record of a method on the scene of the splits, every 8th view held out, paper's plan in full."""
    lines = (RECORDS / f"{SPLIT_SCENE}.jsonl").read_text().splitlines()
    found = (each for line in lines if (each := json.loads(line))["method"] == method and each["rate"] == rate)
    return next((each for each in found if each["preset"] == "paper" and not each["variant"]), None)


def distance_section(folders: Sequence[Path], out: Path) -> list[str]:
    """Draw and list PSNR near to and far from the training views, of every run that tells both, scene by scene."""
    runs = with_distances(collect(folders).runs) if folders else []
    with (out / "distances.csv").open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["scene", "protocol", "run", "seeds", "group", "path_combined", "psnr"])
        for run in runs:
            for name, (distance, value) in zip(NEAR_TO_FAR, reached(run, "psnr").groups, strict=True):
                writer.writerow([*run.place, run.label, len(run.seeds), name, distance, value])
    if not runs:
        return []
    with contextlib.suppress(UserInputError):  # without matplotlib
        write_figures(runs, out / "figures")
    lines = [f"## {HEADING}", "", EXPLAINED, ""]
    for place in dict.fromkeys(run.place for run in runs):
        of_place = [run for run in runs if run.place == place]
        lines += [f"### {place[0]}, `{place[1]}`", "", *table_lines(distance_table(of_place)), ""]
    return lines


def table_lines(table: Table) -> list[str]:
    """A table of sw-report in Markdown, without its title."""
    return to_markdown([("", table)], []).strip().removeprefix("****").strip().splitlines()


def mean_of(record: Mapping[str, Any], name: str, of: set[str] | None = None) -> float | None:
    """Mean of a metric over the views of a record, or over those of `of`."""
    found = record["metrics"].get(name)
    if found is None:
        return None
    pairs = zip(record["views"], found["per_view"], strict=True)
    values = [value for view, value in pairs if of is None or view in of]
    return statistics.fmean(values) if values and None not in values else None
