"""Measure PSNR over the count of Gaussians: presets of 3dgs grown to a count, and grown scenes pruned to it by a score.

    SPLATWIZARD_DATA=DATA python benchmarks/removal_table.py OUT --scene nerf_synthetic/chair --set background=black \\
        --counts 43000,60000,120000 --grown 250000 --gpus 0,1 --jobs 8
    python benchmarks/removal_table.py OUT --scene demo:tiny --counts 200,400 --grown 800 --set iterations=60 \\
        --set scale_schedule=true --device cpu

Rows of a scene, all uncoded, and their Gaussians:

paper             3dgs as it is, whatever count it ends with
fast, mcmc        3dgs grown to the count (`density.settings.cap`); mcmc as published, noise and loss terms to the end
settled           mcmc, the last quarter without relocation, noise and loss terms
mcmc, trained on  the scene of `mcmc`, 10,000 more steps of pruned-3dgs, none removed: what its steps alone bring
X + SCORE         the scene of row X grown to --grown (paper: as it is), pruned to the count by pruned-3dgs with that
                  pruner; the same plan for every score

Cells are those of sweep_cells.py: one `sw bench`, resumed by the same command; at the end stands which ran, were there,
are missing, unfinished or failed. A scene that several rows start from is trained once. Where a row has another count
than was asked for, it stands beside the PSNR. Scenes with other counts: one command each, in the same folder.
No preset ends with fewer Gaussians than it starts with: `--set init_points=30000` where start points are random.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from published import records
from rich.console import Console
from rich.table import Table
from sweep_cells import Cell, add_options, chosen, print_outcomes, run_cells

SCORES = "removal,lightgaussian,pup-3dgs,speedy-splat,trimming-the-fat,opacity"
CAP = "density.settings.cap"
NEVER = 1_000_000
STOPS = {
    "mcmc": {"stop": 25_000, "noise_stop": NEVER, "terms_stop": NEVER},
    "settled": dict.fromkeys(("stop", "noise_stop", "terms_stop"), 22_500),
}
"""Row -> ends of relocation, noise and loss terms, whatever the preset `mcmc` has."""
ANY = 0
"""The count of a row that has one of its own."""

Rows = Mapping[str, Mapping[int, Sequence[Cell]]]


def start_of(row: str, count: int) -> tuple[str, list[str]]:
    """Preset of 3dgs and the values with which the scene of a row grows to a count (ANY: what it grows to)."""
    sets = [f"density.settings.{key}={step}" for key, step in STOPS.get(row, {}).items()]
    return "mcmc" if row in STOPS else row, [*sets, *([f"{CAP}={count}"] if count != ANY else [])]


def grown(row: str, scene: str, seed: int, count: int) -> Cell:
    """A scene of 3dgs, uncoded, grown to a count."""
    preset, sets = start_of(row, count)
    return Cell(f"{row}-{count}" if count != ANY else row, "3dgs", scene, "r6", seed, preset, sets=tuple(sets))


def pruned(row: str, scene: str, seed: int, cap: int, count: int, *sets: str) -> Cell:
    """The scene of row "X + SCORE" or "X, trained on" grown to `cap`, with `count` left (ANY: all), and trained on."""
    preset, values = start_of(row.split(",")[0].split(" + ")[0], cap)
    start = (f"pretrained.preset={preset}", *(f"pretrained.{each}" for each in values))
    left = "prune.keep=1" if count == ANY else f"prune.count={count}"
    label = row.replace(", ", "-").replace(" + ", "-by-").replace(" ", "-")
    return Cell(f"{label}-{count or cap}", "pruned-3dgs", scene, "r3", seed, sets=(*start, left, *sets))


def rows_of(scene: str, counts: Sequence[int], most: int, scores: Sequence[str], seeds: int) -> Rows:
    """Row -> count -> its runs, one a seed."""
    found: dict[str, dict[int, list[Cell]]] = {}

    def add(row: str, count: int, cell: Cell) -> None:
        found.setdefault(row, {}).setdefault(count, []).append(cell)

    for seed in range(seeds):
        add("paper", ANY, grown("paper", scene, seed, ANY))
        for count in counts:
            for row in ("fast", "mcmc", "settled"):
                add(row, count, grown(row, scene, seed, count))
            add("mcmc, trained on", count, pruned("mcmc, trained on", scene, seed, count, ANY))
            for start in ("paper", "fast", "settled"):
                row = f"{start} + removal"
                add(row, count, pruned(row, scene, seed, ANY if start == "paper" else most, count))
            for score in scores:
                row = f"mcmc + {score}"
                add(row, count, pruned(row, scene, seed, most, count, f"prune.pruner={score}"))
    return found


def told(cells: Sequence[Cell], count: int, out: Path) -> str:
    """Mean PSNR of the finished runs, spread of several, and their count where it is not the one asked for."""
    runs = records(path for cell in cells if (path := cell.directory(out) / "metrics.json").is_file())
    psnr = [value for run in runs if (value := run.mean("psnr")) is not None]
    if not psnr:
        return "-"
    spread = f" ±{max(psnr) - min(psnr):.2f}" if len(psnr) > 1 else ""
    number = round(statistics.fmean(next(iter(run.counts.values())) for run in runs))
    return f"{statistics.fmean(psnr):.2f}{spread}" + ("" if number == count else f" ({number:,})")


def print_rows(scene: str, rows: Rows, counts: Sequence[int], out: Path, console: Console) -> None:
    """Print the table of a scene."""
    table = Table(title=f"{scene}: PSNR dB of held-out views, uncoded", title_justify="left")
    for head in ("", *(f"{count:,}" for count in counts), "count of its own"):
        table.add_column(head)
    for row, by_count in rows.items():
        cells = (told(by_count[count], count, out) if count in by_count else "" for count in (*counts, ANY))
        table.add_row(row, *cells)
    console.print(table)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="where the runs are kept")
    add_options(parser)
    parser.add_argument("--scene", action="append", required=True, help="as `sw run --scene` takes it; repeatable")
    parser.add_argument("--counts", default="60000,120000", help="Gaussians, comma list (default: 60000,120000)")
    parser.add_argument("--grown", type=int, default=250_000, help="before pruning (default: 250,000)")
    parser.add_argument("--scores", default=SCORES, help=f"pruners that prune mcmc scenes (default: {SCORES})")
    parser.add_argument("--seeds", type=int, default=1, help="(default: 1)")
    args = parser.parse_args()
    counts, scores = [int(n) for n in args.counts.split(",")], args.scores.split(",")
    tables = {scene: rows_of(scene, counts, args.grown, scores, args.seeds) for scene in args.scene}
    cells = chosen(
        (cell for rows in tables.values() for row in rows.values() for each in row.values() for cell in each), args
    )
    console = Console(width=200)
    outcomes = run_cells(cells, args.out, args)
    if not args.table:
        print_outcomes(outcomes, console, planned=args.plan)
    if not args.plan:
        for scene, rows in tables.items():
            print_rows(scene, rows, counts, args.out, console)
    return int(any(outcome.state == "failed" for outcome in outcomes.values()))


if __name__ == "__main__":
    sys.exit(main())
