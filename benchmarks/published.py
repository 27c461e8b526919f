"""Measure what has been published: one run for each row whose scene is there, and a table measured beside published.

    SPLATWIZARD_DATA=DATA python benchmarks/published.py out/published
    python benchmarks/published.py out/published --only lego --table     # no runs, the table of what is finished
    python benchmarks/published.py out/published --only lego --table --runs out/h200    # and of what stands there

Rows stand in published.json of the package sw-report, which `sw compare --published` reads too: those with a rate point
and a preset of ours, and a scene (dataset/scene under $SPLATWIZARD_DATA, laid out as in docs/datasets.md). Finished
runs are not repeated, interrupted ones go on. A scene that is not there is named.

--runs OUT takes finished runs besides, as benchmarks/results_matrix.py and `sw run` leave them, at any depth: those of
a row's method, rate point, scene and preset; where there is none of that preset, those of `paper`. The table has their
mean over the seeds, and below it stands everything in which they differ from what was published.
Such a row is not run. A record that cannot be read is told and left out.
"""

from __future__ import annotations

import argparse
import functools
import os
import statistics
import subprocess
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table
from sw_report.facts import RunFacts, read_facts
from sw_report.published import FILE as ROWS
from sw_report.published import Figure, differences, read_published, standing_for

from splatwizard_core.api import UserInputError

FIGURES = ("psnr", "ssim", "lpips", "bytes", "gaussians")
METRICS = {"psnr": "psnr", "ssim": "ssim", "lpips": "lpips_vgg_3dgs"}
LAYOUTS = {"nerf_synthetic": "blender"}  # data set -> as what a scene of it in a folder of its own is read
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


@functools.cache
def tell(line: str) -> None:
    """Print a line to stderr, once."""
    print(line, file=sys.stderr, flush=True)


def records(paths: Iterable[Path]) -> list[RunFacts]:
    """The records in these files; what cannot be read is told and left out."""
    found = []
    for path in paths:
        try:
            found.append(read_facts(path)[0])
        except UserInputError as error:
            tell(f"left out: {error}")
    return found


def finished(roots: Sequence[Path]) -> list[RunFacts]:
    """The records of all runs below `roots`, without the trained scenes that others start from."""
    paths = sorted({path for root in roots for path in root.rglob("metrics.json") if ".trained" not in path.parts})
    return records(paths)


def measured(row: Row, out: Path, others: Sequence[RunFacts]) -> list[RunFacts]:
    """The record of a row's own run, else those of other runs that stand for it; empty where there is none.

    Since scenes of several data sets are called alike, another run counts only if it read the row's data set, or a
    folder of its own in that data set's layout.
    """
    own = row.run(out) / "metrics.json"
    if own.is_file() and (found := records([own])):
        return found
    of = row.figure
    return standing_for(row.preset, [
        run for run in others
        if (run.method, run.rate, run.scene) == (of.method, row.rate, row.scene.replace(":", "-"))
        and run.dataset in (of.dataset, LAYOUTS.get(of.dataset))
    ])  # fmt: skip


def mean(runs: Sequence[RunFacts], figure: str) -> float | None:
    """Mean of a figure over runs; None where one of them lacks it, or there is none."""
    if figure in METRICS:
        found = [run.mean(METRICS[figure]) for run in runs]
    else:
        found = [run.file.bytes if figure == "bytes" else run.counts.get("num_gaussians") for run in runs]
    known = [value for value in found if value is not None]
    return statistics.fmean(known) if known and len(known) == len(found) else None


def print_table(rows: Sequence[Row], out: Path, others: Sequence[RunFacts], console: Console) -> None:
    """Measured beside published, and below it where each row comes from and what differs."""
    table = Table(title="measured / published", title_justify="left")
    for column in ("row", *FIGURES, "n", ""):
        table.add_column(column)
    notes = []
    for number, row in enumerate(rows, 1):
        found = measured(row, out, others)
        cells = [f"{_number(mean(found, name), name)} / {_number(getattr(row.figure, name), name)}" for name in FIGURES]
        of = row.figure
        table.add_row(
            f"{number} {of.method} {row.rate} {row.scene}",
            *cells,
            str(len(found)),
            "" if of.verified else "not re-read",
        )
        by = "not measured yet"
        if found:
            by = f"here: {found[0].protocol.id}, {found[0].test_views} test views, preset {found[0].preset}"
        notes.append(f"{number} {of.year}, {of.source}; {_number(of.steps, 'steps')} steps; {of.protocol.text}; {by}")
        presets = {f"preset {run.preset} here, {row.preset} there" for run in found if run.preset != row.preset}
        told = dict.fromkeys(text for run in found for text in differences(run, of)) or of.differs
        notes += [f"  differs: {what}" for what in (*presets, *told)]
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
    parser.add_argument(
        "--runs",
        type=Path,
        action="append",
        default=[],
        metavar="OUT",
        help="finished runs that stand for rows as well",
    )
    args = parser.parse_args()
    if gone := [str(root) for root in args.runs if not root.is_dir()]:
        parser.error(f"--runs: no folder {', '.join(gone)}")
    rows = [row for row in read_rows(args.rows) if args.only in row.name]
    data = os.environ.get("SPLATWIZARD_DATA")
    failed, absent, others = [], [], finished(args.runs)
    for row in [] if args.table else rows:
        why = missing(row, Path(data) if data else None)
        if why is not None:
            absent.append(why)
        elif not measured(row, args.out, others):
            print(f"running {row.name}", flush=True)
            command = [sys.executable, "-m", "splatwizard_core", *row.command(args.out, args.set)]
            if subprocess.run(command, check=False, stdout=subprocess.DEVNULL).returncode != 0:
                failed.append(f"{row.name} failed, see above")
    print_table(rows, args.out, others, Console(width=160))
    for line in (*dict.fromkeys(absent), *failed):
        print(line)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
