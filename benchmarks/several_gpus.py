"""Seconds and quality of one 3DGS training on one GPU and shared by several, one after the other.

    python benchmarks/several_gpus.py DATA/room DATA/fox:images_2 --gpus 2 --batches 2,4 --out out/gpus.jsonl

A scene is FOLDER[:PICTURES], FAMILY:FOLDER[:PICTURES] or demo; the plan is that of preset `paper`, whole or scaled by
--iterations (views, of all GPUs together). Seconds are those of the training loop; starting the other processes is not
part of them, but of `wall`, as is reading pictures. PSNR and SSIM are means over the held-out views. The last column is
how many times as fast as on one GPU a training is, and its distance in PSNR.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import torch
from scene_names import FORMS
from time_to_quality import Job, Variant, trained


def variants_of(gpus: int, batches: list[int], alone: list[int]) -> list[Variant]:
    """Return how each scene is trained: as published first, then in batches on one GPU, then on several."""
    return [
        Variant("1 GPU", "paper"),
        *(Variant(f"1 GPU, batch {each}", "paper", {"batch": each}) for each in alone),
        *(Variant(f"{gpus} GPUs, batch {each}", "paper", {"gpus": gpus, "batch": each}) for each in batches),
    ]


def row(name: str, found: dict[str, Any], first: dict[str, Any]) -> str:
    """Return the line of a training; `first`: that of one GPU."""
    return (
        f"  {name:18} {found['steps']:7,} steps {found['seconds']:7.1f} s (wall {found['wall']:.0f}) "
        f"{found['psnr']:6.2f} dB {found['ssim']:.4f} {found['gaussians']:9,} Gaussians {found['peak_mib']:6.0f} MiB  "
        f"{first['seconds'] / found['seconds']:.2f} times as fast, {found['psnr'] - first['psnr']:+.2f} dB"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", metavar="SCENE", help=FORMS)
    parser.add_argument("--gpus", type=int, default=2, help="GPUs that share a training (default: 2)")
    parser.add_argument("--batches", default="4", help="views in an update there, comma list (default: 4)")
    parser.add_argument("--alone", default="", help="also batches on one GPU, comma list")
    parser.add_argument("--seeds", default="0", help="comma list (default: 0)")
    parser.add_argument("--iterations", type=int, help="scale the plan to so many views (default: 30,000)")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--out", type=Path, metavar="FILE", help="append a line of JSON for each training")
    args = parser.parse_args()
    batches, alone = ([int(each) for each in text.split(",") if each] for text in (args.batches, args.alone))
    for scene in args.scenes:
        for seed in map(int, args.seeds.split(",")):
            print(f"{scene}, seed {seed}", flush=True)
            first: dict[str, Any] | None = None
            for variant in variants_of(args.gpus, batches, alone):
                began = time.monotonic()
                found = trained(Job(scene, variant, seed, args.device, 0, args.iterations, 0))
                found["wall"] = time.monotonic() - began
                first = first or found
                print(row(variant.name, found, first), flush=True)
                if args.out is not None:
                    args.out.parent.mkdir(parents=True, exist_ok=True)
                    with args.out.open("a", encoding="utf-8") as file:
                        told = {"scene": scene, "seed": seed, "variant": variant.name, **variant.sets}
                        file.write(json.dumps({**told, **found, "growth": None}) + "\n")


if __name__ == "__main__":
    main()
