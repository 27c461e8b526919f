"""Measure what has been published: one run for each row whose scene is there, and a table measured beside published.

    SPLATWIZARD_DATA=DATA python benchmarks/published.py out/published
    python benchmarks/published.py out/published --only lego --table     # no runs, the table of what is finished

Rows stand in published.json of the package sw-report, which `sw compare --published` reads too: those with a rate point
and a preset of ours, and a scene (dataset/scene under $SPLATWIZARD_DATA, laid out as in docs/datasets.md). Finished
runs are not repeated, interrupted ones go on. A scene that is not there is named.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table
from sw_report.published import FILE as ROWS
from sw_report.published import Figure, read_published

FIGURES = ("psnr", "ssim", "lpips", "bytes", "gaussians")
METRICS = {"psnr": "psnr", "ssim": "ssim", "lpips": "lpips_vgg_3dgs"}
DIGITS = {"psnr": 2, "ssim": 4, "lpips": 4, "bytes": 0, "gaussians": 0, "steps": 0}


@dataclass(frozen=True)
class Row:
    """A published figure of one scene that can be run here, with the rate point and the preset that are meant."""

    figure: Figure
    scene: str
    rate: str
    preset: str

    @property
    def place(self) -> str:
        """The scene as `sw run` takes it."""
        return f"{self.figure.dataset}/{self.scene}" if self.figure.dataset else self.scene

    @property
    def name(self) -> str:
        return f"{self.figure.method} {self.rate} on {self.place}"

    def run(self, out: Path) -> Path:
        """Its run directory. Presets of a method must not share one."""
        return out / self.preset / self.scene.replace(":", "-") / self.figure.method / self.rate

    def command(self, out: Path, sets: Sequence[str]) -> list[str]:
        words = ["run", "--method", self.figure.method, "--rate", self.rate, "--preset", self.preset]
        words += ["--scene", self.place, "--out", str(out / self.preset)]
        words += ["--images", self.figure.images] if self.figure.images else []
        return [*words, *(word for value in (*self.figure.sets, *sets) for word in ("--set", value))]


def read_rows(path: Path) -> list[Row]:
    """The figures of a file that can be run: of one scene, with a rate point and a preset of ours."""
    return [
        Row(figure, figure.scene, figure.rate, figure.preset)
        for figure in read_published(path)
        if figure.scene is not None and figure.rate is not None and figure.preset is not None
    ]


def missing(row: Row, data: Path | None) -> str | None:
    """Tell why the scene of a row cannot be read; None: it is there. A row without a data set is made on the spot."""
    if not row.figure.dataset:
        return None
    if data is None:
        return f"{row.place}: SPLATWIZARD_DATA is not set"
    folder = data / row.figure.dataset / row.scene
    if folder.is_dir():
        return None
    return f"{row.place}: {folder} is not there (docs/datasets.md)"


def measured(run: Path) -> dict[str, Any] | None:
    """Figures of a finished run, and the protocol that they were measured by; None: it is not finished."""
    path = run / "metrics.json"
    if not path.exists():
        return None
    record = json.loads(path.read_text("utf-8"))
    found: dict[str, Any] = {figure: record["metrics"].get(name, {}).get("mean") for figure, name in METRICS.items()}
    return found | {
        "bytes": record["file"]["bytes"],
        "gaussians": record["counts"].get("num_gaussians"),
        "steps": record["train"]["steps"],
        "protocol": record["protocol"]["id"],
        "views": record["test_views"],
    }


def print_table(rows: Sequence[Row], out: Path, console: Console) -> None:
    """Measured beside published, and below it where each row comes from and what differs."""
    table = Table(title="measured / published", title_justify="left")
    for column in ("row", *FIGURES, ""):
        table.add_column(column)
    notes = []
    for number, row in enumerate(rows, 1):
        found = measured(row.run(out))
        here = dict.fromkeys(FIGURES) if found is None else found
        cells = [f"{_number(here[name], name)} / {_number(getattr(row.figure, name), name)}" for name in FIGURES]
        table.add_row(
            f"{number} {row.figure.method} {row.rate} {row.scene}", *cells, "" if row.figure.verified else "not re-read"
        )
        by = "not measured yet" if found is None else f"here: {found['protocol']}, {found['views']} test views"
        of = row.figure
        notes.append(f"{number} {of.year}, {of.source}; {_number(of.steps, 'steps')} steps; {of.protocol.text}; {by}")
        notes += [f"  differs: {what}" for what in of.differs]
    console.print(table)
    for note in notes:
        console.print(note, markup=False, highlight=False)


def _number(value: float | None, figure: str) -> str:
    return "-" if value is None else f"{value:,.{DIGITS[figure]}f}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="where the runs are kept")
    parser.add_argument(
        "--rows", type=Path, default=ROWS, help="file of rows (default: the published.json of sw-report)"
    )
    parser.add_argument("--only", default="", help="rows whose name holds this text")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="for all runs, on top")
    parser.add_argument("--table", action="store_true", help="no runs, only the table of what is finished")
    args = parser.parse_args()
    rows = [row for row in read_rows(args.rows) if args.only in row.name]
    data = os.environ.get("SPLATWIZARD_DATA")
    failed, absent = [], []
    for row in [] if args.table else rows:
        why = missing(row, Path(data) if data else None)
        if why is not None:
            absent.append(why)
        elif measured(row.run(args.out)) is None:
            print(f"running {row.name}", flush=True)
            command = [sys.executable, "-m", "splatwizard_core", *row.command(args.out, args.set)]
            if subprocess.run(command, check=False, stdout=subprocess.DEVNULL).returncode != 0:
                failed.append(f"{row.name} failed, see above")
    print_table(rows, args.out, Console(width=160))
    for line in (*dict.fromkeys(absent), *failed):
        print(line)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
