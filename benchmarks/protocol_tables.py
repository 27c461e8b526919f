"""Tables about protocols: trained models through codecs, metrics against metrics, splits that hold out a side.

    python benchmarks/protocol_tables.py DATA out/protocols --plan                          # what would be trained
    python benchmarks/protocol_tables.py DATA out/protocols --gpus 0,1,2,3 --jobs 4         # everything
    python benchmarks/protocol_tables.py DATA out/protocols --parts gsc,scores,tables --models PLY --device cuda
    python benchmarks/protocol_tables.py DATA out/protocols --parts tables                  # from what is there

DATA holds the scenes chair, lego, room and fox. Parts, in this order; each does only what is not there yet:

train       3DGS on every scene (Blender scenes on black, which is what the protocol draws on), and 3DGS, HAC++,
            CAT-3DGS and wisp on room, with every 8th view held out and with a sector of 60 degrees. --steps scales all
            plans alike, such as --steps 10000 of 3DGS's 30,000; the tables then say so by the runs' steps.
gsc         `sw bench --protocol mpeg-gsc` of every scene's model (that of --models DIR, NAME.ply, where it is there;
            else of `train`), one process a codec, seen from the scene's test views: every k-th where there are more
            than 32.
scores      `sw eval` of every file of `gsc` on the same views, against the photographs, by all metrics; and of every
            run under OUT/train and --runs DIR on its own test views. Records of earlier releases lack distances:
            `path_distances.py` adds them.
tables      From what is there, rate points of codecs that were cut off included: OUT/tables.md, gsc.csv, gsc_bd.csv,
            correlations.csv, splits.csv, distances.csv, distance.html, and figures of the distances where matplotlib
            is. `protocol_page.py OUT` puts them into docs/other_protocols.md.

Metrics whose package or weights are not there are `not available`, and missing in the tables. --set
metrics.lpips.weights=DIR says where LPIPS finds its weights. Processes run side by side, --gsc-jobs of gsc and scores
on the same GPUs, so that the tables leave seconds and memory out. Where the anchor is not coded, others are set against
3DGS's own codec.

Correlations are over renders: one view of one decoded file. Every metric is turned so that higher is better. `pooled`
takes all renders together, where views differ more than codecs; `within` is the mean over views of the correlation over
the files that show the view, where at least 8 do.
"""

from __future__ import annotations

import argparse
import itertools
import subprocess
import sys
import time
from pathlib import Path

from protocol_codecs import (
    ANCHOR,
    SECOND_ANCHOR,
    SHARED,
    distinct,
    gsc_rows,
    gsc_section,
    reference_of,
    run_gsc,
    views_of,
)
from protocol_jobs import SW
from protocol_scores import correlation_section, run_scores
from protocol_splits import distance_section, split_section
from protocol_trainings import model_of, training_cells
from rich.console import Console
from sw_bench.gsc.protocol import not_available
from sw_bench.gsc.tables import BD_COLUMNS, COLUMNS, bd_rows, csv_text
from sweep_cells import add_options, chosen, print_outcomes, run_cells

from splatwizard_core.tooling import load_plugins

SCENES = ("chair", "lego", "room", "fox")
PARTS = ("train", "gsc", "scores", "tables")


def write_tables(args: argparse.Namespace) -> None:
    """Write everything that can be told from what is there."""
    rows = gsc_rows(args)
    by_scene = [list(group) for _, group in itertools.groupby(rows, key=lambda row: row["sequence"])]
    bd = []
    for anchor in (ANCHOR, SECOND_ANCHOR):
        those = [row for of_scene in by_scene if reference_of(of_scene) == anchor for row in distinct(of_scene)]
        bd += bd_rows(those, anchor)
    (args.out / "gsc.csv").write_text(csv_text([name for name in COLUMNS if name not in SHARED], rows))
    (args.out / "gsc_bd.csv").write_text(csv_text(BD_COLUMNS, bd))
    trained = [folder for folder in (args.out / "train", *args.runs) if any(folder.rglob("metrics.json"))]
    text = [*gsc_section(rows, bd, args.rates), *correlation_section(rows, args), *split_section(args)]
    text += distance_section(trained, args.out)
    (args.out / "tables.md").write_text("\n".join(text) + "\n")
    if trained:
        words = ["report", *map(str, trained), "--distance", str(args.out / "distance.html")]
        subprocess.run([*SW, *words], check=False, stdout=sys.stderr)
    print(f"written: {args.out / 'tables.md'}, CSV files, distance.html")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="folder of the scenes")
    parser.add_argument("out", type=Path, help="everything that is made")
    parser.add_argument("--parts", default=",".join(PARTS), help=f"which of {', '.join(PARTS)} (default: all)")
    parser.add_argument("--scenes", default=",".join(SCENES), help="default: all four")
    parser.add_argument(
        "--models", type=Path, metavar="DIR", help="trained models NAME.ply (default: of the trainings)"
    )
    parser.add_argument("--codecs", default="", help="default: all that train nothing")
    parser.add_argument("--runs", type=Path, action="append", default=[], metavar="DIR", help="further run directories")
    parser.add_argument("--steps", type=int, help="of 3DGS, all plans scaled alike (default: in full)")
    parser.add_argument("--gsc-jobs", type=int, default=1, help="processes of gsc and scores at a time (default: 1)")
    parser.add_argument("--threads", type=int, default=1, help="of each of these (default: 1)")
    add_options(parser)
    args = parser.parse_args()
    args.begun = time.monotonic()
    args.out.mkdir(parents=True, exist_ok=True)
    parts, scenes = args.parts.split(","), args.scenes.split(",")
    if unknown := set(parts) - set(PARTS):
        parser.error(f"--parts: {', '.join(sorted(unknown))}: give some of {', '.join(PARTS)}")
    if "train" in parts:
        cells = chosen(training_cells(args.data, scenes, args.steps), args)
        outcomes = run_cells(cells, args.out / "train", args)
        print_outcomes(outcomes, Console(width=160), planned=args.plan)
    if args.plan:
        return
    models = {scene: model for scene in scenes if (model := model_of(scene, args)) is not None}
    if {"gsc", "scores"} & set(parts):
        missing = [scene for scene in scenes if scene not in models]
        print(f"models: {', '.join(models) or 'none'}; missing: {', '.join(missing) or 'none'}")
        plugins = load_plugins()
        views = {scene: views_of(args.data, scene, plugins) for scene in models}
        if "gsc" in parts:
            absent = not_available(plugins)
            free = [e.name for e in plugins.methods if e.declared.get("training_free") and e.name not in absent]
            run_gsc(models, args.codecs.split(",") if args.codecs else free, views, args)
        if "scores" in parts:
            run_scores(models, views, args)
    if "tables" in parts:
        declared = {e.name: e.declared for e in load_plugins().methods if e.declared.get("training_free")}
        args.rates = {name: of["rates"] for name, of in declared.items() if len(of.get("rates") or []) > 1}
        write_tables(args)


if __name__ == "__main__":
    main()
