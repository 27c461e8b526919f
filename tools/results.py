"""Make every table and plot of measured runs in README.md, docs/results.md and docs/formats.md from docs/records.

    python tools/results.py collect OUT...       # records of all runs under OUT into docs/records, then what follows
    python tools/results.py tables               # the tables and plots alone
    python tools/results.py tables --check       # status 1 where one and its records disagree; writes nothing

A table stands between `<!-- table NAME SCENE -->` and `<!-- end -->` and is wholly written by this script; SCENE is a
file docs/records/SCENE.jsonl, of `table trainers` docs/records/trainers/SCENE.jsonl; `table claims all` looks at the
scenes that a claim names, `table published SCENE` and its short form `table published-brief SCENE` at the published
figures of the methods' packages too. Between
`<!-- plot SCENE -->` and `<!-- end -->` stands docs/images/rd-SCENE.svg. Values are means over the runs ± the deviation
of the sample (n - 1).
"""

from __future__ import annotations

import argparse
import re
import statistics
import sys
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path

import result_claims
import result_plots
import result_published
import trainer_records
from result_groups import BASE, NONE, TITLES, Rows, points, rate, smaller, spread, title
from result_records import FROM, MIB, RECORDS, ROOT, extract, merged, read, write

from splatwizard_core.tooling import load_plugins

PAGES = (ROOT / "docs" / "results.md", ROOT / "README.md", ROOT / "docs" / "formats.md")
MARKED = re.compile(r"(<!-- (?:table|(?=plot)) ?(\w[\w-]*) (\w[\w.-]*) -->\n).*?(<!-- end -->)", re.S)


def quality_table(records: Rows) -> list[list[str]]:
    """Quality and size at every rate point."""
    has_lpips = any(r.lpips is not None for r in records)
    head = ["method", "rate", "PSNR dB", "SSIM", *(["LPIPS"] if has_lpips else []), "bytes", "x", "Gaussians",
            "anchors", "encode s", "decode s", "n"]  # fmt: skip
    rows = [head]
    for group in points(records):
        lpips = [spread([r.lpips for r in group], 4)] if has_lpips else []
        rows.append([
            title(group), rate(group), spread([r.psnr for r in group], 2), spread([r.ssim for r in group], 4), *lpips,
            spread([r.bytes for r in group], 0), spread(smaller(group, records), 1),
            spread([r.gaussians for r in group], 0), spread([r.anchors for r in group], 0),
            spread([r.encode_s for r in group], 2), spread([r.decode_s for r in group], 2), str(len(group)),
        ])  # fmt: skip
    return rows


def cost_table(records: Rows) -> list[list[str]]:
    """Time and memory at every default rate point: rendering alone on the GPU, with the rasterizer that drew."""
    rows = [["method", "rate", "starts from", "taught by", "steps", "train s", "start s", "train MiB", "rendering MiB",
             "FPS, one rasterizer for all", "FPS, its own", "drawn by", "n"]]  # fmt: skip
    for group in points([r for r in records if r.default_rate]):
        first = group[0]
        alone, quiet = [r for r in group if r.alone], [r for r in group if r.fps_alone]
        steps = sorted({r.steps for r in group if r.steps is not None})
        rows.append([
            title(group), rate(group), first.starts_from, ", ".join(first.taught_by) or NONE,
            " / ".join(f"{n:,}" for n in steps) or NONE,
            spread([r.train_s for r in alone], 0), spread([r.start_s for r in alone], 0),
            spread([None if r.train_bytes is None else r.train_bytes / MIB for r in group], 0),
            spread([r.render_bytes / MIB for r in group], 0),
            spread([r.default_fps for r in quiet], 0), spread([r.fps for r in quiet], 0),
            first.rasterizer or NONE, str(len(group)),
        ])  # fmt: skip
    return rows


def brief_table(records: Rows) -> list[list[str]]:
    """Default rate points, and every file of 3DGS, for a first look."""
    rows = [["method", "rate", "PSNR, dB", "bytes", "x", "Gaussians", "n"]]
    rows += [
        [title(g), rate(g), spread([r.psnr for r in g], 2), spread([r.bytes for r in g], 0),
         spread(smaller(g, records), 1), spread([r.gaussians for r in g], 0), str(len(g))]
        for g in points(records) if g[0].default_rate or g[0].method == BASE
    ]  # fmt: skip
    return rows


def formats_table(records: Rows) -> list[list[str]]:
    """Files of one scene, the smallest first: what each holds, from which training, and its seconds."""
    rows = [["method", "rate", "bytes", "x", "PSNR dB", "SSIM", "Gaussians", "starts from", "taught by", "steps",
             "encode s", "decode s", "n"]]  # fmt: skip
    for group in sorted(points(records), key=lambda group: statistics.fmean(r.bytes for r in group)):
        first = group[0]
        rows.append([
            title(group), rate(group), spread([r.bytes for r in group], 0), spread(smaller(group, records), 1),
            spread([r.psnr for r in group], 2), spread([r.ssim for r in group], 4),
            spread([r.gaussians for r in group], 0),
            first.starts_from, ", ".join(first.taught_by) or NONE, f"{first.steps:,}" if first.steps else NONE,
            spread([r.encode_s for r in group], 2), spread([r.decode_s for r in group], 2), str(len(group)),
        ])  # fmt: skip
    return rows


def starts_table(records: Rows) -> list[list[str]]:
    """Each method from its usual start beside the same from another one, with the difference between equal seeds."""
    groups = points(records)
    usual = {(g[0].method, g[0].rate): g for g in groups if not g[0].variant}
    pairs = [(usual[g[0].method, g[0].rate], g) for g in groups if g[0].variant]
    names = sorted({tuple(started_by(g) for g in pair) for pair in pairs})
    if len(names) != 1:
        raise SystemExit(f"a table of starts compares two presets, and here are {names}")
    before, after = names[0]
    rows = [["method", "rate", f"PSNR dB, `{before}`", f"`{after}`", "difference", f"SSIM, `{before}`", f"`{after}`",
             f"bytes, `{before}`", f"`{after}`", "ratio", "n"]]  # fmt: skip
    for old, new in pairs:
        seeds = {r.seed: r for r in old}
        same = [(seeds[r.seed], r) for r in new if r.seed in seeds]
        psnr = [None if None in (a.psnr, b.psnr) else b.psnr - a.psnr for a, b in same]
        rows.append([
            TITLES.get(new[0].method, new[0].method), rate(new),
            *(spread([pair[i].psnr for pair in same], 2) for i in (0, 1)), spread(psnr, 2),
            *(spread([pair[i].ssim for pair in same], 4) for i in (0, 1)),
            *(spread([pair[i].bytes for pair in same], 0) for i in (0, 1)),
            spread([b.bytes / a.bytes for a, b in same], 2), str(len(same)),
        ])  # fmt: skip
    return rows


def started_by(group: Rows) -> str:
    """Name the preset that trained the 3DGS scene of these runs, which may be they themselves."""
    first = group[0]
    return first.variant.removeprefix(FROM) or first.preset


TABLES: dict[str, Callable[[Rows], list[list[str]]]] = {
    "quality": quality_table, "cost": cost_table, "brief": brief_table, "formats": formats_table,
    "starts": starts_table,
}  # fmt: skip


def table(name: str, scene: str, records_at: Path = RECORDS) -> str:
    """Write one table, and below it where its records come from. Raises SystemExit for a name that is none."""
    if name == "trainers":
        return trainer_records.table(records_at / "trainers" / f"{scene}.jsonl")
    if name == "claims":
        return result_claims.table(records_at)
    if name in ("published", "published-brief"):
        return result_published.table(scene, records_at, brief=name == "published-brief")
    if name == "plot":
        return result_plots.shown(scene, records_at)
    if name not in TABLES:
        raise SystemExit(
            f"no table is called '{name}'; one of {', '.join([*TABLES, 'trainers', 'claims', 'published'])}"
        )
    path = records_at / f"{scene}.jsonl"
    if not path.exists():
        return f"*No records of {scene} yet.*\n"
    records = read(path)
    if len({r.protocol for r in records}) > 1:
        raise SystemExit(f"{path}: runs of several protocols cannot stand in one table")
    head, *rows = TABLES[name](records)
    left = [f"| {' | '.join(row)} |" for row in rows]
    first = records[0]
    devices, dates = sorted({r.device for r in records}), sorted({r.date for r in records})
    views = f"{first.train_views} training and {first.test_views} test views of {first.images}"
    presets = "/".join(sorted({r.preset for r in records}))
    when = dates[0] if len(dates) == 1 else f"{dates[0]} to {dates[-1]}"
    source = f"{views}, protocol `{first.protocol}`, preset {presets}; {', '.join(devices)}, {when}"
    return "\n".join([f"| {' | '.join(head)} |", "|---" * len(head) + "|", *left, "", f"{source}.", ""])


def filled(text: str, records_at: Path = RECORDS) -> str:
    """Return a page with all its tables made anew."""
    return MARKED.sub(lambda m: f"{m[1]}{table(m[2], m[3], records_at)}{m[4]}", text)


def collect(
    roots: Sequence[Path], records_at: Path = RECORDS, *, name: str = "", repetition: int = 0, fresh: bool = False
) -> list[Path]:
    """Keep the small records of all runs under `roots`, by scene; one with the key of an older one takes its place.

    name        of the file in place of the scene's, if all runs are of one scene
    repetition  of all of them: those of another number stay beside them
    fresh       drop the records that are there, once the new ones have been read

    Raises SystemExit where there is no run, or the runs of several protocols would come together.
    """
    plugins = load_plugins()
    runs = sorted(
        {path.parent for root in roots for path in root.rglob("metrics.json") if ".trained" not in path.parts}
    )
    if not runs:
        raise SystemExit(f"no metrics.json below {', '.join(map(str, roots))}")
    by_file = defaultdict(list)
    for run in runs:
        record = extract(run, plugins, repetition)
        by_file[name or record.scene].append(record)
    written = []
    for file, new in by_file.items():
        path = records_at / f"{file}.jsonl"
        found = merged(read(path) if path.exists() and not fresh else [], new)
        if len({r.protocol for r in found}) > 1:
            told = ", ".join(sorted({r.protocol for r in found}))
            raise SystemExit(f"{path} would hold several protocols ({told}): keep them apart by --name")
        write(found, path)
        written.append(path)
    return written


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    gather = commands.add_parser("collect", help="records of runs, then the tables")
    gather.add_argument("out", nargs="+", type=Path, metavar="OUT", help="where runs lie, at any depth")
    gather.add_argument("--name", default="", help="of the file in docs/records (default: the scene)")
    gather.add_argument("--repetition", type=int, default=0, help="number of this matrix of runs (default: 0)")
    gather.add_argument("--fresh", action="store_true", help="drop the records that are there")
    write_tables = commands.add_parser("tables", help="the tables from the records")
    write_tables.add_argument("--check", action="store_true", help="write nothing, status 1 where they disagree")
    args = parser.parse_args()
    if args.command == "collect":
        if args.fresh and not args.name:
            parser.error("--fresh needs --name")
        for path in collect(args.out, name=args.name, repetition=args.repetition, fresh=args.fresh):
            print(path)
    stale = []
    for page in PAGES:
        text = page.read_text("utf-8")
        made = filled(text)
        if made != text:
            stale.append(page)
            if args.command == "collect" or not args.check:
                page.write_text(made, encoding="utf-8")
                print(f"{page}: tables rewritten")
        for scene in [found[3] for found in MARKED.finditer(text) if found[2] == "plot"]:
            if result_plots.is_stale(scene):
                stale.append(result_plots.path_of(scene))
                if args.command == "collect" or not args.check:
                    result_plots.draw(scene)
                    print(f"{result_plots.path_of(scene)}: drawn")
    if args.command == "tables" and args.check and stale:
        print(f"tables and docs/records disagree in {', '.join(p.name for p in stale)}: python tools/results.py tables")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
