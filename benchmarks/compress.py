"""Bytes of `sw compress` at the rendered quality of .spz and .sog files of the same scene, as ratios.

    python benchmarks/compress.py garden.ply room.ply [--device cpu] [--json FILE]
    python benchmarks/compress.py garden.ply --of "spz 8-bit SH" --without precision --without basis

Each scene is written as .spz (version 3 and 4, and with 8-bit spherical harmonics) and .sog as other programs write
them; each of these is drawn from cameras that were made up, and `sw compress --quality` is asked for the same PSNR
against the source. A ratio below 1 is a smaller file. Where finest settings do not reach a file's quality, `-` stands.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from sw_compress import coders, reducing, search
from sw_compress.compressing import compress
from sw_compress.quality import Pictures
from sw_compress.source import open_source
from sw_compress.views import made_up_views
from sw_interchange import decode, encode, from_gaussians, to_gaussians

from splatwizard_core.api import RasterOptions, UserInputError
from splatwizard_core.tooling import NegotiatedRasterizer, choose_device, load_plugins

BASELINES: dict[str, tuple[str, dict[str, Any]]] = {
    "spz 3": ("spz", {"version": 3, "level": 6}),
    "spz 4": ("spz", {"version": 4, "level": 12}),
    "spz 8-bit SH": ("spz", {"version": 4, "level": 12, "sh1_bits": 8, "sh_bits": 8}),
    "sog": ("sog", {}),
}
LARGEST_QUALITY = 69.0
"""dB; `sw compress` takes no more."""


PARTS: dict[str, tuple[ModuleType, str, Any]] = {
    "precision": (coders, "PRECISION_POWER", 0.0), "basis": (coders, "OWN_BASIS", False),
    "fewer": (search, "SHARES", (1.0,)),
    "merging": (reducing, "POWERS", (1.0,)), "pruning": (reducing, "POWERS", (0.0,)),
}  # fmt: skip
"""Parts that `--without` takes away, each as a constant of sw-compress and its value without; `fewer`: all stay."""


def compared(path: Path, device: str, baselines: list[str]) -> list[dict[str, Any]]:
    """Bytes and dB of each baseline of a scene, and those of `sw compress` at that quality."""
    plugins = load_plugins()
    chosen = choose_device(device, plugins)
    source = open_source(path, plugins, chosen)
    rasterizer = NegotiatedRasterizer(plugins, device=chosen, options=source.raster)
    with torch.no_grad():
        seen = made_up_views(source.model, rasterizer, None)
        held_out = Pictures(source.model, seen.held_out, rasterizer, RasterOptions(alpha=True))
    scene = from_gaussians(source.model)
    rows = []
    for name in baselines:
        form, options = BASELINES[name]
        data, _ = encode(scene, form, **options)
        found = held_out.quality(to_gaussians(decode(data, form)).to(chosen))
        row: dict[str, Any] = {
            "scene": path.stem, "gaussians": source.read, "baseline": name, "bytes": len(data), "psnr": found.psnr
        }  # fmt: skip
        began = time.perf_counter()
        try:
            done = compress(path, quality=min(found.psnr, LARGEST_QUALITY), device=device, plugins=plugins)
        except UserInputError as error:
            row |= {"ratio": None, "why": str(error)}
        else:
            record = done.record
            row |= {
                "ours": record["bytes"], "ours_psnr": record["quality"]["psnr"], "ours_gaussians": record["gaussians"],
                "ratio": record["bytes"] / len(data), "seconds": time.perf_counter() - began,
                "peak_bytes": record["peak_bytes"],
            }  # fmt: skip
        rows.append(row)
        print(told(row), flush=True)
    return rows


def told(row: dict[str, Any]) -> str:
    """A line of the table."""
    head = f"{row['scene']:12} {row['gaussians']:>9,} {row['baseline']:13} {row['bytes']:>11,} {row['psnr']:6.2f} dB"
    if row["ratio"] is None:
        return f"{head}  - ({row['why']})"
    ours = f"{row['ours']:>11,} {row['ours_psnr']:6.2f} dB {row['ours_gaussians']:>9,}"
    return f"{head} | {ours} | {row['ratio']:.3f} | {row['seconds']:6.1f} s"


def main() -> None:
    """Print a line for each scene and baseline, then the mean ratio of each baseline."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--of", action="append", choices=BASELINES, help="only this baseline; may be repeated")
    parser.add_argument("--without", action="append", choices=PARTS, default=[], help="without a part of sw compress")
    given = parser.parse_args()
    for part in given.without:
        module, name, value = PARTS[part]
        setattr(module, name, value)
    print("scene        gaussians file                bytes  quality |        ours quality    gaussians | ratio | time")
    rows = [row for path in given.scenes for row in compared(path, given.device, given.of or list(BASELINES))]
    for name in BASELINES:
        ratios = [row["ratio"] for row in rows if row["baseline"] == name and row["ratio"] is not None]
        if ratios:
            print(f"mean over {len(ratios)} scenes, of {name}: {sum(ratios) / len(ratios):.3f}")
    if given.json:
        given.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    sys.exit(main())
