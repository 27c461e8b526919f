"""Formats that viewers take beside the papers' codecs: bytes, PSNR and seconds, from one trained 3DGS scene each.

    python benchmarks/formats_table.py                                            # demo, preset quick, CPU
    python benchmarks/formats_table.py DATA/fox:images_2 DATA/room --device cuda --steps 7000 --out out/formats

A scene is FOLDER[:PICTURES], FAMILY:FOLDER[:PICTURES] or demo.

Every row is a `sw run`: encoded, decoded in a fresh process, evaluated on the test views. 3DGS r1 to r6 and the formats
encode the same Gaussians; LightGaussian prunes and distils them; ChimeraGS trains its own, taught by them. --steps
scales all plans by the same factor. Finished runs are not done again. Bytes are those of the .swz; those of a format's
own file, a few hundred fewer, stand beside them. Needs sw-interchange, sw-3dgs, sw-lightgaussian and sw-chimerags, with
zstandard and Pillow (WebP), and no network.

    python tools/results.py collect OUT/SCENE --name formats-SCENE       # keeps the rows, for docs/formats.md
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from scene_names import FORMS, split_scene

from splatwizard_core.plugins import load_plugins

SW = [sys.executable, "-m", "splatwizard_core"]
FORMATS = ("spz", "sog", "compressed-ply", "splat")
FULL_STEPS = 30_000  # of 3DGS, preset paper
PLANS = {
    # method -> whether it needs the scene of 3dgs, its `iterations` in preset paper; 0: it trains nothing
    "3dgs": (False, FULL_STEPS),
    ",".join(FORMATS): (True, 0),
    "lightgaussian": (True, 5_000),
    "chimerags": (True, 30_000),
}


def run(scene: str, methods: str, steps: int | None, rates: str, shared: list[str]) -> None:
    """Run rate points of some methods on a scene; a method that fails is told and left out.

    shared  words of the command line that are those of all methods: the scene and more
    """
    starts, full = PLANS[methods]
    own_rates = rates if methods in ("lightgaussian", "chimerags") else "all"
    words = ["run", "--method", methods, "--rate", own_rates, *shared]
    if steps is not None:
        own = ["scale_schedule=true", f"iterations={max(1, round(full * steps / FULL_STEPS))}"] if full else []
        before = ["pretrained.scale_schedule=true", f"pretrained.iterations={steps}"] if starts else []
        words += [word for value in own + before for word in ("--set", value)]
    done = subprocess.run([*SW, *words], stdout=sys.stderr, check=False)
    if done.returncode:
        print(f"{methods} on {scene} ended with status {done.returncode}", file=sys.stderr)


def rows(out: Path) -> list[dict[str, Any]]:
    """The records below a folder as rows, by scene, then by bytes."""
    found = []
    for path in sorted(out.rglob("metrics.json")):
        record = json.loads(path.read_text(encoding="utf-8"))
        file, codec = record["file"], record["codec"]
        found.append({
            "scene": record["scene"], "method": record["method"], "rate": record["rate"], "bytes": file["bytes"],
            "own": file["sections"].get("file"), "gaussians": record["counts"]["num_gaussians"],
            "psnr": record["metrics"]["psnr"]["mean"], "ssim": record["metrics"]["ssim"]["mean"],
            "encode_s": codec["encode_s"], "decode_s": codec["decode_s"],
        })  # fmt: skip
    return sorted(found, key=lambda row: (row["scene"], row["bytes"]))


def print_table(found: list[dict[str, Any]]) -> None:
    """Print a Markdown table a scene."""
    for scene in dict.fromkeys(row["scene"] for row in found):
        print(f"\n{scene}\n")
        print("| method | rate | bytes | of the format | Gaussians | PSNR | SSIM | encode | decode |")
        print("|---|---|---|---|---|---|---|---|---|")
        for row in (row for row in found if row["scene"] == scene):
            own = f"{row['own']:,}" if row["own"] is not None else ""
            print(
                f"| {row['method']} | {row['rate']} | {row['bytes']:,} | {own} | {row['gaussians']:,} "
                f"| {row['psnr']:.2f} | {row['ssim']:.4f} | {row['encode_s']:.2f} s | {row['decode_s']:.2f} s |"
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", default=["demo"], metavar="SCENE", help=f"{FORMS} (default: demo)")
    parser.add_argument("--out", type=Path, default=Path("out/formats"), help="root of the run directories")
    parser.add_argument("--device", default="auto", help="auto, cpu or cuda (default: auto)")
    parser.add_argument("--preset", help="of all methods (default: quick on demo, else paper)")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="of the whole run, such as resolution=2"
    )
    parser.add_argument("--steps", type=int, help="of 3DGS, all plans of preset paper scaled alike (default: in full)")
    parser.add_argument(
        "--methods", default="3dgs,formats,lightgaussian,chimerags", help="which of these (default: all four)"
    )
    parser.add_argument(
        "--rates", default="all", help="of LightGaussian and ChimeraGS, which train anew for each (default: all)"
    )
    parser.add_argument("--json", type=Path, help="also write the rows into this file")
    args = parser.parse_args()
    names = {"formats": ",".join(FORMATS)}
    shared = ["--out", str(args.out), "--device", args.device]
    shared += ["--preset", args.preset] if args.preset else []
    shared += [word for value in args.set for word in ("--set", value)]
    plugins = load_plugins()
    for scene in args.scenes:
        path, images = split_scene(scene, plugins)
        of_scene = ["--scene", path, *(["--images", images] if images else [])]
        for method in args.methods.split(","):
            run(scene, names.get(method, method), args.steps, args.rates, [*of_scene, *shared])
    found = rows(args.out)
    print_table(found)
    if args.json is not None:
        args.json.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
