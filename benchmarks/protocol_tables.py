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
import contextlib
import csv
import dataclasses
import hashlib
import itertools
import json
import math
import os
import statistics
import subprocess
import sys
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from sw_bench.gsc import TITLE
from sw_bench.gsc.protocol import not_available
from sw_bench.gsc.tables import BD_COLUMNS, COLUMNS, QUALITIES, bd_rows, csv_text
from sw_report.blocks import Table
from sw_report.distance import EXPLAINED, HEADING, NEAR_TO_FAR, distance_table, reached, spearman, with_distances
from sw_report.equal_psnr import CurvePoint, at_equal
from sw_report.exports import to_markdown
from sw_report.figures import write_figures
from sw_report.runs import collect
from sweep_cells import Cell, add_options, chosen, print_outcomes, run_cells

from splatwizard_core.api import SceneOptions, UserInputError
from splatwizard_core.tooling import PluginManager, load_plugins, load_scene

SW = [sys.executable, "-m", "splatwizard_core"]
SCENES = ("chair", "lego", "room", "fox")
BLACK = "background=black"
ANCHOR, SECOND_ANCHOR = "gsc-quant", "3dgs"
SHARED = ("enc_s", "dec_s", "rss_enc_mb", "rss_dec_mb")
MODEL_RATE = "r6"  # of 3dgs: float32, as trained
SPLIT_SCENE, SECTOR = "room", "sector:60@130"
SPLIT_METHODS = (("3dgs", MODEL_RATE, 30_000), ("hac-plus", "r4", 30_000), ("cat-3dgs", "r6", 40_000),
                 ("wisp", "r3", 18_000))  # fmt: skip
"""Method, its default rate point (3dgs: without a loss), steps of preset paper."""
STARTS = {"wisp": 30_000}  # steps of the 3DGS scene that it starts from
FULL_STEPS = 30_000
RECORDS = Path(__file__).resolve().parents[1] / "docs" / "records"
MOST_VIEWS = 32
LEAST_FILES = 8  # that show a view, for a correlation within it
METRICS = ("psnr", "ssim", "l1", "lpips_vgg_3dgs", "lpips_vgg", "lpips_alex", "cc_psnr", "cc_ssim", "flip", "ms_ssim",
           "haarpsi", "fsim", "vsi", "gmsd", "cvvdp")  # fmt: skip
SPLIT_METRICS = ("psnr", "ssim", "lpips_vgg_3dgs")
SPLIT_COLUMNS = ("method", "rate", "metric", "every8", "every8_in_sector", "sector", "fall", "views_every8",
                 "views_sector", "protocol_every8", "protocol_sector", "steps_every8", "steps_sector")  # fmt: skip
AGAINST_SOURCE = ("psnr_rgb", "psnr_yuv", "ssim_yuv", "om_psnr_rgb", "om_ssim_yuv")
"""Scores of the protocol against renders of the source model, all higher is better."""
PARTS = ("train", "gsc", "scores", "tables")

Render = tuple[str, str, str]
"""Scene, view, and file that shows it."""


@dataclass(frozen=True)
class Job:
    """A process: its name, its words after `sw`, and the file whose presence says that it has ended well.

    stdout  where what it prints goes; None: its log alone
    """

    name: str
    words: tuple[str, ...]
    done: Path
    stdout: Path | None = None


# Trainings


def training_cells(data: Path, scenes: Sequence[str], steps: int | None) -> list[Cell]:
    """Every training that the tables need."""
    cells = [Cell("3dgs", "3dgs", str(data / scene), MODEL_RATE, sets=(*_black(data, scene), *_scaled("3dgs", steps)))
             for scene in scenes]  # fmt: skip
    for method, rate, _ in SPLIT_METHODS if SPLIT_SCENE in scenes else ():
        room, sets = str(data / SPLIT_SCENE), _scaled(method, steps)
        cells.append(Cell(method, method, room, rate, sets=sets))
        cells.append(Cell(f"{method}-sector", method, room, rate, sets=(f"split={SECTOR}", *sets)))
    return list(dict.fromkeys(cells))


def _black(data: Path, scene: str) -> tuple[str, ...]:
    return (BLACK,) if (data / scene / "transforms_test.json").is_file() else ()


def _scaled(method: str, steps: int | None) -> tuple[str, ...]:
    if steps is None:
        return ()
    full = next(n for name, _, n in SPLIT_METHODS if name == method)
    own = ("scale_schedule=true", f"iterations={round(full * steps / FULL_STEPS)}")
    if method not in STARTS:
        return own
    return (*own, "pretrained.scale_schedule=true", f"pretrained.iterations={steps}")


def model_of(scene: str, args: argparse.Namespace) -> Path | None:
    """Find a scene's trained model, .ply: that of --models, else the training's, exported once; None: neither."""
    if args.models is not None and (given := args.models / f"{scene}.ply").is_file():
        return given
    kept = args.out / "models" / f"{scene}.ply"
    trained = Cell("3dgs", "3dgs", str(args.data / scene), MODEL_RATE).directory(args.out / "train") / "scene.swz"
    if trained.is_file() and not kept.is_file():
        kept.parent.mkdir(parents=True, exist_ok=True)
        subprocess.run([*SW, "export", str(trained), str(kept)], check=True, stdout=sys.stderr)
    return kept if kept.is_file() else None


# Processes


def run_jobs(jobs: Sequence[Job], args: argparse.Namespace) -> Counter[str]:
    """Run processes side by side, those whose result is not there; say what became of each."""
    gpus = itertools.cycle(args.gpus.split(",")) if args.gpus else None
    states: Counter[str] = Counter()
    lock = threading.Lock()

    def work(job: Job) -> None:
        left = math.inf if args.deadline is None else args.deadline - (time.monotonic() - args.begun)
        if job.done.is_file():
            state, seconds = "was there", 0.0
        elif left <= 0:
            state, seconds = "unfinished", 0.0
        else:
            with lock:
                gpu = {} if gpus is None else {"CUDA_VISIBLE_DEVICES": next(gpus)}
            began = time.monotonic()
            state = _process(job, {"OMP_NUM_THREADS": str(args.threads), **os.environ, **gpu}, left)
            seconds = time.monotonic() - began
        with lock:
            states[state] += 1
            print(f"{state}: {job.name}" + (f", {seconds:.0f} s" if seconds else ""), flush=True)

    with ThreadPoolExecutor(args.gsc_jobs) as pool:
        list(pool.map(work, jobs))
    return states


def _process(job: Job, environment: dict[str, str], left: float) -> str:
    """Run one; its standard output is kept only if it ends well."""
    log = job.done.with_name(f"{job.done.name}.log")
    log.parent.mkdir(parents=True, exist_ok=True)
    printed = log if job.stdout is None else job.stdout.with_name(f"{job.stdout.name}.part")
    with log.open("wb") as err, open(os.devnull, "wb") if job.stdout is None else printed.open("wb") as out:
        try:
            status = subprocess.run(
                [*SW, *job.words], stdout=out, stderr=err, env=environment, stdin=subprocess.DEVNULL,
                timeout=None if left == math.inf else left,
            ).returncode  # fmt: skip
        except subprocess.TimeoutExpired:
            return "unfinished"
    if status != 0:
        lines = log.read_text(errors="replace").strip().splitlines()
        return f"failed ({lines[-1][:200] if lines else f'status {status}'})"
    if job.stdout is not None:
        printed.replace(job.stdout)
    return "ran"


# Models through codecs


def views_of(data: Path, scene: str, plugins: PluginManager) -> tuple[list[str], bool]:
    """Names of the test views that are drawn, and whether these are fewer than the scene has."""
    names = [view.name for view in load_scene(str(data / scene), SceneOptions(), plugins).test]
    every = math.ceil(len(names) / MOST_VIEWS)
    return names[::every], every > 1


def gsc_words(scene: str, model: Path, views: tuple[list[str], bool], args: argparse.Namespace) -> list[str]:
    """Words of the protocol's command for one scene, without its codecs."""
    words = ["bench", "--protocol", "mpeg-gsc", str(model), "--cameras", str(args.data / scene)]
    words += ["--views", ",".join(views[0])] if views[1] else []
    words += ["--out", str(args.out / "gsc" / scene), "--json"]
    return words + (["--device", args.device] if args.device else [])


def gsc_folder(scene: str, args: argparse.Namespace) -> Path:
    """Folder that the protocol writes of one scene."""
    found: Path = args.out / "gsc" / scene / "mpeg-gsc"
    return found


def run_gsc(
    models: Mapping[str, Path], codecs: Sequence[str], views: Mapping[str, Any], args: argparse.Namespace
) -> None:
    """Code every model by every codec, one process each, then collect a scene's rows in one."""
    jobs = []
    for (scene, model), codec in itertools.product(models.items(), codecs):
        alone = ["--method", codec, "-o", f"anchor={codec}"]
        done = gsc_folder(scene, args) / f"{codec}.done.json"
        jobs.append(Job(f"gsc {scene} {codec}", (*gsc_words(scene, model, views[scene], args), *alone), done, done))
    print(f"gsc: {dict(run_jobs(jobs, args))}")
    together = []
    for scene, model in models.items():
        if all((gsc_folder(scene, args) / f"{codec}.done.json").is_file() for codec in codecs):
            done = gsc_folder(scene, args) / "all.done.json"
            words = (*gsc_words(scene, model, views[scene], args), "--method", ",".join(codecs))
            together.append(Job(f"gsc {scene}, all rows", words, done, done))
    print(f"gsc: {dict(run_jobs(together, args))}")


def gsc_rows(args: argparse.Namespace) -> list[dict[str, Any]]:
    """Rows of every scene that has a folder, which names them: of finished codecs, and of rate points of unfinished.

    Without what other processes on the machine falsify: seconds and memory.
    """
    rows = []
    for folder in sorted(args.out.glob("gsc/*/mpeg-gsc")):
        scene, found = folder.parent.name, []
        if (whole := folder / "all.done.json").is_file():
            found = json.loads(whole.read_bytes())["rows"]
        else:
            for done in sorted(folder.glob("*.done.json")):
                found += json.loads(done.read_bytes())["rows"]
            known = {row["codec"] for row in found}
            for file in sorted(folder.glob("*/*/r*.json")):
                if file.parent.name not in known:
                    found.append(json.loads(file.read_bytes())["row"])
        rows += [{**row, "sequence": scene, **dict.fromkeys(SHARED)} for row in found]
    return rows


def distinct(rows: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows where neighbouring rate points of a codec whose files do not differ are one, `r1 to r4`."""

    def same(row: Mapping[str, Any]) -> Any:
        return [row.get(key) for key in ("sequence", "codec", "bytes", "psnr_rgb_pooled", "reason")]

    found = []
    for _, each in itertools.groupby(rows, key=same):
        group = list(each)
        rates = [row["rate"] for row in group]
        found.append({**group[0], "rate": rates[0] if len(rates) == 1 else f"{rates[0]} to {rates[-1]}"})
    return found


def unfinished(rows: Sequence[Mapping[str, Any]], rates: Mapping[str, Sequence[str]]) -> dict[str, dict[str, str]]:
    """Scene -> codec -> its rate points that have no row, of codecs that have some in any scene."""
    found: dict[str, dict[str, str]] = {}
    for scene in dict.fromkeys(row["sequence"] for row in rows):
        there = {(row["codec"], row["rate"]) for row in rows if row["sequence"] == scene}
        for codec, of_codec in rates.items():
            missing = [rate for rate in of_codec if (codec, rate) not in there]
            if missing and any(codec == name for name, _ in there):
                found.setdefault(scene, {})[codec] = ", ".join(missing)
    return found


def reference_of(of_scene: Iterable[Mapping[str, Any]]) -> str:
    """Codec that others are set against: the anchor, or where it is not coded the codec that has a curve."""
    coded = {row["codec"] for row in of_scene if row["bytes"] is not None}
    return ANCHOR if ANCHOR in coded else SECOND_ANCHOR


# Metrics


def run_scores(scenes: Iterable[str], views: Mapping[str, Any], args: argparse.Namespace) -> None:
    """Measure every decoded file, by every metric, on photographs."""
    base = ["--metrics", ",".join(METRICS), "--no-speed", "--quiet", "--json"]
    base += ["--device", args.device] if args.device else []
    base += [word for value in args.set for word in ("--set", value)]
    jobs = []
    for scene in scenes:
        own = ["--scene", str(args.data / scene)]
        own += [word for value in _black(args.data, scene) for word in ("--set", value)]
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


# Tables


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


def gsc_section(
    rows: Sequence[dict[str, Any]], bd: Sequence[dict[str, Any]], rates: Mapping[str, Sequence[str]]
) -> list[str]:
    """Bytes at equal PSNR, BD-rates, what is missing, and every point of every codec."""
    if not rows:
        return []
    scenes = {scene: distinct(each) for scene, each in itertools.groupby(rows, key=lambda row: row["sequence"])}
    references = {scene: reference_of(of_scene) for scene, of_scene in scenes.items()}
    lines = [f"## Models through codecs, {TITLE}", ""]
    lines += [
        "Bytes over those of another codec's curve at the same pooled RGB-PSNR against renders of the source; a dash "
        "is a PSNR that the curve does not reach. Rate points whose files do not differ are one.",
        "",
    ]
    lines += _head(["codec", *(f"{scene}, over `{references[scene]}`" for scene in scenes)])
    for codec in dict.fromkeys(row["codec"] for row in rows):
        cells = []
        for of_scene in scenes.values():
            points = [row for row in of_scene if row["codec"] == codec and row["bytes"] is not None]
            told = [(row["rate"], times_anchor(row, of_scene)) for row in points]
            cells.append(", ".join(f"{rate}: {ratio:.2f}" for rate, ratio in told if ratio is not None) or "-")
        if set(cells) != {"-"}:
            lines.append(_line([codec, *cells]))
    lines.append("")
    for anchor in dict.fromkeys(references.values()):
        those = [scene for scene in scenes if references[scene] == anchor]
        coded = [row["codec"] for row in bd if row["anchor"] == anchor]
        if not coded:
            lines += [f"BD-rates against `{anchor}` ({', '.join(those)}): none, no other codec has four points.", ""]
            continue
        lines += [f"BD-rate against `{anchor}`, %: RGB-PSNR / YUV-PSNR / YUV-SSIM; four points or more.", ""]
        lines += _head(["codec", *those])
        for codec in dict.fromkeys(coded):
            cells = []
            for scene in those:
                found = next((row for row in bd if (row["codec"], row["sequence"]) == (codec, scene)), None)
                cells.append("-" if found is None else " / ".join(_percent(found[f"bd_{name}"]) for name in QUALITIES))
            lines.append(_line([codec, *cells]))
        lines.append("")
    missing = unfinished(rows, rates)
    if missing:
        each = (f"{scene} ({'; '.join(f'{c} {r}' for c, r in of.items())})" for scene, of in missing.items())
        lines += [f"Not coded, the run was cut off: {', '.join(each)}.", ""]
    head = ["codec", "rate", "bytes", "bits/splat", "PSNR RGB", "pooled", "PSNR YUV", "SSIM YUV", "photographs: PSNR",
            "drop", "x bytes", "remarks"]  # fmt: skip
    for scene, of_scene in scenes.items():
        views = next((row["views"] for row in of_scene if row["bytes"] is not None), 0)
        first = of_scene[0]
        lines += [
            f"### {scene}",
            "",
            f"{first['splats_source']:,} splats, {views} views, `{first['protocol']}`; x bytes: over "
            f"`{references[scene]}` at the same pooled PSNR",
            "",
        ]
        lines += _head(head)
        for row in of_scene:
            if row["bytes"] is None:
                why = f"{row['flags']}: {row.get('reason', '')}"
                lines.append(_line([row["codec"], row["rate"], *["-"] * 9, why]))
                continue
            photos = row.get("photos", {}).get("psnr", {})
            lines.append(_line([
                row["codec"], row["rate"], f"{row['bytes']:,}", _number(row["bits_per_splat"], 1),
                _number(row["psnr_rgb"]), _number(row["psnr_rgb_pooled"]), _number(row["psnr_yuv"]),
                _number(row["ssim_yuv"], 4), _number(photos.get("decoded")), _number(photos.get("drop")),
                _number(times_anchor(row, of_scene)), row["flags"],
            ]))  # fmt: skip
        lines.append("")
    return lines


def times_anchor(row: Mapping[str, Any], of_scene: Sequence[Mapping[str, Any]]) -> float | None:
    """Bytes of a rate point over those of the anchor's curve at its RGB-PSNR; None where that does not reach it.

    PSNR is pooled, which is defined for all points but exact ones.
    """
    key, anchor = "psnr_rgb_pooled", reference_of(of_scene)
    curve = [CurvePoint(each["rate"], each["bytes"], each[key]) for each in of_scene
             if each["codec"] == anchor and each["bytes"] is not None and each[key] is not None]  # fmt: skip
    if row[key] is None or row["codec"] == anchor:
        return None
    ratio = at_equal(curve, row[key], row["bytes"]).ratio
    return None if ratio is None else 1 / ratio


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
        lines += [f"### {title}: Pearson above the diagonal, Spearman below", "", *_head(["", *names])]
        for i, a in enumerate(names):
            cells = []
            for j, b in enumerate(names):
                found = pairs.get((a, b)) if i < j else pairs.get((b, a))
                cells.append("" if found is None else _number(getattr(found, above if i < j else below)))
            lines.append(_line([f"`{a}`", *cells]))
        lines.append("")
    return lines


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
                means = [_mean_of(near, name), _mean_of(near, name, set(far["views"])), _mean_of(far, name)]
                views, protocol, steps = near["test_views"], near["protocol"]["id"], near["train"]["steps"]
            elif kept is not None:
                means = [kept.get(name), None, _mean_of(far, name)]
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
    lines += _head(["method", "rate", "metric", "every8", "every8, views inside the sector", "sector", "fall", "steps"])
    for row in table:
        near_steps, far_steps = ("-" if n is None else f"{n:,}" for n in row[11:13])
        steps = near_steps if near_steps == far_steps else f"{near_steps}, sector {far_steps}"
        lines.append(_line([*row[:3], *(_number(v, 2 if row[2] == "psnr" else 4) for v in row[3:7]), steps]))
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


def _mean_of(record: Mapping[str, Any], name: str, of: set[str] | None = None) -> float | None:
    """Mean of a metric over the views of a record, or over those of `of`."""
    found = record["metrics"].get(name)
    if found is None:
        return None
    pairs = zip(record["views"], found["per_view"], strict=True)
    values = [value for view, value in pairs if of is None or view in of]
    return statistics.fmean(values) if values and None not in values else None


def _head(cells: Sequence[str]) -> list[str]:
    return [_line(cells), _line(["---"] * len(cells))]


def _line(cells: Iterable[Any]) -> str:
    return "| " + " | ".join(map(str, cells)) + " |"


def _number(value: float | None, digits: int = 2) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{value:+.1f}"


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
