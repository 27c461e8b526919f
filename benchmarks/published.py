"""Measure what has been published: every row whose scene is there, several processes a GPU, and a table beside it.

    SPLATWIZARD_DATA=DATA python benchmarks/published.py out/published --plan          # the cells, and what is there
    SPLATWIZARD_DATA=DATA python benchmarks/published.py out/published --only chair --gpus 0,1,2,3 --jobs 20
    python benchmarks/published.py out/published --only chair --table                  # no runs, the table so far
    python benchmarks/published.py out/published --only lego --table --runs out/h200   # and of what stands there

Rows are the published figures of the installed methods (their published.toml, docs/plugins.md): those of one scene with
a preset. Scenes are those of $SPLATWIZARD_DATA (dataset/scene, docs/datasets.md); one that is not there is named. One
seed each, three of HAC and HAC++, whose other rate points are run with the first seed, so that their curve has a size
at the published PSNR. `--also c3dgs@r4` adds rate points without a published counterpart on the same scenes.

The runs are those of `sw bench`: finished ones are not repeated, interrupted ones go on, and a 3DGS scene that several
methods start from is trained once. At the end stands which cells ran, were there, are missing, unfinished or failed.

The table has, for each row, the mean over the seeds (± their deviation), the difference in dB at our rate point of the
same name, the bytes as a multiple of the published ones, the same of our rate points interpolated in log bytes at the
published PSNR, and the dB that they are better at the published bytes. Nothing is extrapolated. Below stand the overlap
of each method's PSNR range with the published one, and everything in which a run differs from what was published.

--runs OUT takes finished runs besides, as `sw run` and benchmarks/results_matrix.py leave them, at any depth: those of
a row's method, rate point, scene and preset; where there is none of that preset, those of `paper`. A record that cannot
be read is told and left out.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
import re
import statistics
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table
from sw_report.equal_psnr import AtEqual, CurvePoint, at_equal, overlap
from sw_report.facts import RunFacts, read_facts
from sw_report.published import differences, standing_for
from sw_report.published_files import Figure, read_published
from sweep_cells import Cell, add_options, chosen, print_outcomes, run_cells

from splatwizard_core.api import UserInputError
from splatwizard_core.plugins import load_plugins

METRICS = {"psnr": "psnr", "ssim": "ssim", "lpips": "lpips_vgg_3dgs"}
LAYOUTS = {"nerf_synthetic": "blender"}  # data set -> as what a scene of it in a folder of its own is read
SEEDS = {"hac": 3, "hac-plus": 3, "cat-3dgs": 3}  # whose trainings differ most from seed to seed
CURVES = "hac,hac-plus"  # published at two rate points, far apart
HEADS = (
    "row", "PSNR dB", "published", "Δ dB", "SSIM", "published", "LPIPS", "published", "bytes", "published", "x",
    "x at equal PSNR", "dB at equal bytes", "primitives", "published", "n",
)  # fmt: skip


@dataclass(frozen=True)
class Row:
    """A published figure of one scene that can be run here, and the name of its method's values in the sweep."""

    figure: Figure
    label: str

    @property
    def place(self) -> str:
        """The scene as `sw run` takes it."""
        return "/".join(filter(None, (self.figure.dataset, self.figure.scene)))

    @property
    def name(self) -> str:
        return f"{self.label} {self.figure.rate} {self.place}"

    def cell(self, seed: int, rate: str | None = None) -> Cell:
        """The run that measures it, or the same at another rate point."""
        of = self.figure
        return Cell(self.label, of.method, self.place, rate or str(of.rate), seed, str(of.preset), of.images,
                    tuple(of.sets))  # fmt: skip


@dataclass(frozen=True)
class Measured:
    """Runs that stand beside a row.

    runs    at its rate point, a record a seed
    curve   of all rate points with such runs
    equal   the published point against that curve
    """

    row: Row
    runs: list[RunFacts]
    curve: list[CurvePoint]
    equal: AtEqual

    def mean(self, figure: str) -> float | None:
        return mean(self.runs, figure)


def rows_of(figures: Iterable[Figure]) -> list[Row]:
    """The figures that can be run: of one scene, with a rate point and a preset of an installed method.

    A label is the method's name for the preset `paper`, else METHOD-PRESET; a second configuration with one label on
    one scene gets a number.
    """
    methods, found = load_plugins().methods, []
    known: dict[tuple[str, str], list[tuple[object, ...]]] = {}
    for of in figures:
        if None in (of.scene, of.rate, of.preset) or of.method not in methods:
            continue
        label = of.method if of.preset == "paper" else f"{of.method}-{of.preset}"
        values = of.images, tuple(of.sets)
        seen = known.setdefault((label, f"{of.dataset}/{of.scene}"), [])
        if values not in seen:
            seen.append(values)
        number = seen.index(values) + 1
        found.append(Row(of, label if number == 1 else f"{label}-{number}"))
    return found


def cells_of(rows: Sequence[Row], seeds: Mapping[str, int], curves: Sequence[str], also: Sequence[str]) -> list[Cell]:
    """The runs of these rows; with all rate points of `curves` methods, and `also` METHOD[:PRESET][@RATE+RATE]."""
    methods, found = load_plugins().methods, []
    for row in rows:
        method = row.figure.method
        found += [row.cell(seed) for seed in range(seeds.get(method, seeds.get("", 1)))]
        if method in curves:
            found += [row.cell(0, rate) for rate in methods.entry(method).declared.get("rates", ())]
    for text in also:
        name, _, rates = text.partition("@")
        method, _, preset = name.partition(":")
        label = method if preset in ("", "paper") else f"{method}-{preset}"
        for place in dict.fromkeys(row.place for row in rows):
            like = next((r for r in rows if (r.label, r.place) == (label, place)), None)
            for rate in rates.split("+") if rates else [methods.load(method).DEFAULT_RATE]:
                plain = Cell(label, method, place, rate, preset=preset or "paper")
                found.append(like.cell(0, rate) if like else plain)
    return list(dict.fromkeys(found))


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


def own_runs(row: Row, rate: str, out: Path) -> list[RunFacts]:
    """The records of a row's own runs at a rate point, a record a seed."""
    below = row.cell(0, rate).directory(out).relative_to(out)
    root, inner = re.escape(below.parts[0]).replace("seed\\-0", r"seed-\d+", 1), Path(*below.parts[1:])
    roots = sorted(path for path in out.glob("seed-*") if re.fullmatch(root, path.name))
    return records(path for each in roots if (path := each / inner / "metrics.json").is_file())


def others_for(row: Row, rate: str, others: Sequence[RunFacts]) -> list[RunFacts]:
    """Other runs that stand for a row at a rate point; maybe none.

    Since scenes of several data sets are called alike, another run counts only if it read the row's data set, or a
    folder of its own in that data set's layout.
    """
    of = row.figure
    return standing_for(of.preset, [
        run for run in others
        if (run.method, run.rate, run.scene) == (of.method, rate, str(of.scene).replace(":", "-"))
        and run.dataset in (of.dataset, LAYOUTS.get(of.dataset))
    ])  # fmt: skip


def runs_of(row: Row, rate: str, out: Path, others: Sequence[RunFacts]) -> list[RunFacts]:
    """A row's own runs at a rate point, else others that stand for it."""
    return own_runs(row, rate, out) or others_for(row, rate, others)


def measured(row: Row, out: Path, others: Sequence[RunFacts]) -> Measured:
    """Gather what stands beside a row."""
    of, curve = row.figure, []
    for rate in load_plugins().methods.entry(of.method).declared.get("rates", ()):
        runs = runs_of(row, rate, out, others)
        psnr, size = mean(runs, "psnr"), mean(runs, "bytes")
        if psnr is not None and size is not None:
            curve.append(CurvePoint(rate, size, psnr))
    return Measured(row, runs_of(row, str(of.rate), out, others), curve, at_equal(curve, of.psnr, of.bytes))


def values(runs: Sequence[RunFacts], figure: str) -> list[float | None]:
    """A figure of each run."""
    if figure in METRICS:
        return [run.mean(METRICS[figure]) for run in runs]
    return [run.file.bytes if figure == "bytes" else run.counts.get("num_gaussians") for run in runs]


def mean(runs: Sequence[RunFacts], figure: str) -> float | None:
    """Mean of a figure over runs; None where one of them lacks it, or there is none."""
    found = values(runs, figure)
    known = [value for value in found if value is not None]
    return statistics.fmean(known) if known and len(known) == len(found) else None


def cells(each: Measured, number: int) -> list[str]:
    """The cells of a row in the table, in the order of HEADS."""
    of, equal = each.row.figure, each.equal
    psnr, size = each.mean("psnr"), each.mean("bytes")
    return [
        f"{number} {each.row.label} {of.rate} {of.scene}{'' if of.verified else ' *'}",
        _spread(each.runs, "psnr", 2), _number(of.psnr, 2),
        "-" if None in (psnr, of.psnr) else f"{psnr - of.psnr:+.2f}",  # type: ignore[operator]
        _spread(each.runs, "ssim", 4), _number(of.ssim, 4), _spread(each.runs, "lpips", 4), _number(of.lpips, 4),
        _spread(each.runs, "bytes", 0), _number(of.bytes, 0),
        "-" if None in (size, of.bytes) else f"{size / of.bytes:.3f}",  # type: ignore[operator]
        _number(equal.ratio, 3), "-" if equal.gain is None else f"{equal.gain:+.2f}",
        _spread(each.runs, "gaussians", 0), _number(of.gaussians, 0), str(len(each.runs)),
    ]  # fmt: skip


def notes(each: Measured, number: int) -> list[str]:
    """List what a reader must know of a row: source, why there is no size at equal PSNR, what differs."""
    of, runs = each.row.figure, each.runs
    steps = "" if of.steps is None else f" {of.steps:,} steps;"
    by = "not measured yet"
    if runs:
        by = f"here: {runs[0].protocol.id}, {runs[0].test_views} test views, preset {runs[0].preset}"
    found = [f"{number} {of.year}, {of.source};{steps} {of.protocol.text}; {by}"]
    if each.equal.why and runs and of.bytes:
        found.append(f"  no bytes at equal PSNR: {each.equal.why}")
    presets = {f"preset {run.preset} here, {of.preset} there" for run in runs if run.preset != of.preset}
    told = dict.fromkeys(text for run in runs for text in differences(run, of)) or of.differs
    return found + [f"  differs: {what}" for what in (*presets, *told)]


def overlaps(found: Sequence[Measured]) -> list[str]:
    """Tell which share of the published and the measured PSNR range of each method on a scene is common."""
    lines = []
    groups: dict[tuple[str, str], list[Measured]] = {}
    for each in found:
        groups.setdefault((each.row.label, each.row.place), []).append(each)
    for (label, place), group in groups.items():
        published = [each.row.figure.psnr for each in group if each.row.figure.psnr is not None]
        share = overlap(group[0].curve, published)
        if share is not None:
            scores = [point.psnr for point in group[0].curve]
            there, here = (f"{min(each):.2f} to {max(each):.2f}" for each in (published, scores))
            lines.append(f"overlap {label} {place}: {100 * share:.0f} %, published {there}, here {here} dB")
    return lines


def print_table(found: Sequence[Measured], console: Console, *, markdown: bool = False) -> None:
    """Measured beside published, and below it where each row comes from and what differs."""
    lines = [cells(each, number) for number, each in enumerate(found, 1)]
    if markdown:
        rules = "|---" * len(HEADS) + "|"
        for text in (f"| {' | '.join(HEADS)} |", rules, *(f"| {' | '.join(line)} |" for line in lines)):
            print(text)
    else:
        table = Table(title="measured beside published (* second-hand or recalled)", title_justify="left")
        for head in HEADS:
            table.add_column(head)
        for line in lines:
            table.add_row(*line)
        console.print(table)
    below = [*overlaps(found), *(note for number, each in enumerate(found, 1) for note in notes(each, number))]
    for line in below:
        console.print(line, markup=False, highlight=False)


def as_facts(each: Measured) -> dict[str, object]:
    """A row as JSON data: published, measured by seed, the curve."""
    return {
        "label": each.row.label, "published": each.row.figure.model_dump(mode="json"),
        "measured": {name: values(each.runs, name) for name in (*METRICS, "bytes", "gaussians")},
        "curve": [dataclasses.asdict(point) for point in each.curve], "at_equal": dataclasses.asdict(each.equal),
    }  # fmt: skip


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:,.{digits}f}"


def _spread(runs: Sequence[RunFacts], figure: str, digits: int) -> str:
    """Mean ± deviation of the sample over the seeds."""
    found = mean(runs, figure)
    known = [value for value in values(runs, figure) if value is not None]
    more = f" ± {statistics.stdev(known):,.{digits}f}" if found is not None and len(known) > 1 else ""
    return _number(found, digits) + more


def seeds_of(text: str) -> dict[str, int]:
    """Read `3` or `hac=5,hac-plus=5,1`: seeds of a method, and of all others. Raises ValueError."""
    given: dict[str, int] = {}
    for word in filter(None, text.split(",")):
        name, _, count = word.rpartition("=")
        given[name] = int(count)
        if given[name] < 1:
            raise ValueError(f"{word}: at least one seed")
    return given if "" in given else {**SEEDS, **given}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="where the runs are kept")
    add_options(parser)
    parser.add_argument("--seeds", default="", help="such as 1, or hac=5,hac-plus=5 (default: three of "
                                                    f"{', '.join(SEEDS)}, one of others)")  # fmt: skip
    parser.add_argument("--curves", default=CURVES, metavar="METHODS",
                        help=f"those whose every rate point is run with one seed (default: {CURVES})")  # fmt: skip
    parser.add_argument("--also", action="append", default=[], metavar="METHOD[:PRESET][@RATE+RATE]",
                        help="further rate points on the same scenes; repeatable")  # fmt: skip
    parser.add_argument("--runs", type=Path, action="append", default=[], metavar="OUT",
                        help="finished runs that stand for rows as well")  # fmt: skip
    parser.add_argument("--markdown", action="store_true", help="print the table as Markdown")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows there too")
    args = parser.parse_args()
    if gone := [str(root) for root in args.runs if not root.is_dir()]:
        parser.error(f"--runs: no folder {', '.join(gone)}")
    try:
        seeds = seeds_of(args.seeds)
    except ValueError as error:
        parser.error(f"--seeds: {error}")
    everything = rows_of(read_published())
    others = finished(args.runs)
    wanted = chosen(cells_of(everything, seeds, args.curves.split(","), args.also), args)
    scenes = {(cell.label, cell.scene, cell.rate) for cell in wanted}
    rows = [row for row in everything if (row.label, row.place, str(row.figure.rate)) in scenes]
    console = Console(width=220)
    stand = {(r.label, r.place, r.figure.rate) for r in rows if others_for(r, str(r.figure.rate), others)}
    outcomes = run_cells([c for c in wanted if (c.label, c.scene, c.rate) not in stand], args.out, args)
    if not args.table:
        print_outcomes(outcomes, console, planned=args.plan)
    if not args.plan:
        found = [each for row in rows if (each := measured(row, args.out, others)).runs or args.table]
        print_table(found, console, markdown=args.markdown)
        if args.json:
            args.json.write_text(json.dumps([as_facts(each) for each in found], indent=1) + "\n", encoding="utf-8")
    return int(any(outcome.state == "failed" for outcome in outcomes.values()))


if __name__ == "__main__":
    sys.exit(main())
