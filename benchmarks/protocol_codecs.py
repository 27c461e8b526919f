"""Trained models through codecs by the protocol of the MPEG GSC exploration: its processes, its rows, their tables."""

from __future__ import annotations

import argparse
import itertools
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from markdown_tables import head, line, number, percent
from protocol_jobs import Job, run_jobs
from sw_bench.gsc import TITLE
from sw_bench.gsc.tables import QUALITIES
from sw_report.equal_psnr import CurvePoint, at_equal

from splatwizard_core.api import SceneOptions
from splatwizard_core.tooling import PluginManager, load_scene

ANCHOR, SECOND_ANCHOR = "gsc-quant", "3dgs"
SHARED = ("enc_s", "dec_s", "rss_enc_mb", "rss_dec_mb")
MOST_VIEWS = 32


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
    lines += head(["codec", *(f"{scene}, over `{references[scene]}`" for scene in scenes)])
    for codec in dict.fromkeys(row["codec"] for row in rows):
        cells = []
        for of_scene in scenes.values():
            points = [row for row in of_scene if row["codec"] == codec and row["bytes"] is not None]
            told = [(row["rate"], times_anchor(row, of_scene)) for row in points]
            cells.append(", ".join(f"{rate}: {ratio:.2f}" for rate, ratio in told if ratio is not None) or "-")
        if set(cells) != {"-"}:
            lines.append(line([codec, *cells]))
    lines.append("")
    for anchor in dict.fromkeys(references.values()):
        those = [scene for scene in scenes if references[scene] == anchor]
        coded = [row["codec"] for row in bd if row["anchor"] == anchor]
        if not coded:
            lines += [f"BD-rates against `{anchor}` ({', '.join(those)}): none, no other codec has four points.", ""]
            continue
        lines += [f"BD-rate against `{anchor}`, %: RGB-PSNR / YUV-PSNR / YUV-SSIM; four points or more.", ""]
        lines += head(["codec", *those])
        for codec in dict.fromkeys(coded):
            cells = []
            for scene in those:
                found = next((row for row in bd if (row["codec"], row["sequence"]) == (codec, scene)), None)
                cells.append("-" if found is None else " / ".join(percent(found[f"bd_{name}"]) for name in QUALITIES))
            lines.append(line([codec, *cells]))
        lines.append("")
    missing = unfinished(rows, rates)
    if missing:
        each = (f"{scene} ({'; '.join(f'{c} {r}' for c, r in of.items())})" for scene, of in missing.items())
        lines += [f"Not coded, the run was cut off: {', '.join(each)}.", ""]
    columns = ["codec", "rate", "bytes", "bits/splat", "PSNR RGB", "pooled", "PSNR YUV", "SSIM YUV",
               "photographs: PSNR", "drop", "x bytes", "remarks"]  # fmt: skip
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
        lines += head(columns)
        for row in of_scene:
            if row["bytes"] is None:
                why = f"{row['flags']}: {row.get('reason', '')}"
                lines.append(line([row["codec"], row["rate"], *["-"] * 9, why]))
                continue
            photos = row.get("photos", {}).get("psnr", {})
            lines.append(line([
                row["codec"], row["rate"], f"{row['bytes']:,}", number(row["bits_per_splat"], 1),
                number(row["psnr_rgb"]), number(row["psnr_rgb_pooled"]), number(row["psnr_yuv"]),
                number(row["ssim_yuv"], 4), number(photos.get("decoded")), number(photos.get("drop")),
                number(times_anchor(row, of_scene)), row["flags"],
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
