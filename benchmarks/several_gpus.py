"""Seconds and quality of one 3DGS training on one GPU and shared by several, one after the other.

    python benchmarks/several_gpus.py DATA/room DATA/fox:images_2 --gpus 2 --batches 2,4 --out out/gpus.jsonl

A scene is FOLDER[:PICTURES], FAMILY:FOLDER[:PICTURES] or demo; the plan is that of preset `paper`, whole or scaled by
--iterations (views, of all GPUs together). Seconds are those of the training loop: starting the other processes is not
part of them, nor is reading pictures. PSNR and SSIM are means over the held-out views. The table at the end says how
many times as fast as on one GPU a training is, and how far from it in PSNR; means over the seeds that each has.

--alone     also batches on one GPU
--out FILE  a line of JSON a training; what stands there is not trained again
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from scene_names import FORMS
from time_to_quality import Job, Variant, run

ONE = Variant("1 GPU", "paper")


def table(lines: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yield the rows of each scene, one for each variant."""
    for scene in dict.fromkeys(line["job"]["scene"] for line in lines):
        yield f"\n{scene}"
        groups: dict[str, list[Mapping[str, Any]]] = {}
        for line in lines:
            if line["job"]["scene"] == scene:
                groups.setdefault(line["job"]["variant"]["name"], []).append(line)
        one = groups.get(ONE.name)
        for name, group in groups.items():
            seconds, psnr, ssim, rows = (mean(group, key) for key in ("seconds", "psnr", "ssim", "gaussians"))
            compared = ""
            if one is not None:
                times = mean(one, "seconds") / seconds
                compared = f"  {times:.2f} times as fast, {psnr - mean(one, 'psnr'):+.2f} dB"
            yield (
                f"  {name:18} {len(group)} seeds {group[0]['steps']:7,} steps {seconds:7.1f} s {psnr:6.2f} dB "
                f"{ssim:.4f} {rows:9,.0f} Gaussians {mean(group, 'peak_mib'):6.0f} MiB{compared}"
            )


def mean(group: Sequence[Mapping[str, Any]], key: str) -> float:
    return statistics.fmean(line[key] for line in group)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", metavar="SCENE", help=FORMS)
    parser.add_argument("--gpus", type=int, default=2, help="GPUs that share a training (default: 2)")
    parser.add_argument("--batches", default="4", help="views in an update there, comma list (default: 4)")
    parser.add_argument("--alone", default="", help="also batches on one GPU, comma list")
    parser.add_argument("--seeds", default="0", help="comma list (default: 0)")
    parser.add_argument("--one-seeds", help="of the trainings on one GPU (default: the same)")
    parser.add_argument("--iterations", type=int, help="scale the plan to so many views (default: 30,000)")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--out", type=Path, metavar="FILE", help="lines of JSON, which a second call goes on from")
    args = parser.parse_args()
    alone, batches = ([int(each) for each in text.split(",") if each] for text in (args.alone, args.batches))
    one = [ONE, *(Variant(f"1 GPU, batch {each}", "paper", {"batch": each}) for each in alone)]
    several = [Variant(f"{args.gpus} GPUs, batch {n}", "paper", {"gpus": args.gpus, "batch": n}) for n in batches]
    jobs = [
        Job(scene, variant, int(seed), args.device, 0, args.iterations, 0)
        for scene in args.scenes
        for variants, seeds in ((one, args.one_seeds or args.seeds), (several, args.seeds))
        for seed in seeds.split(",")
        for variant in variants
    ]
    print("\n".join(table(run(jobs, args.out, 1))))


if __name__ == "__main__":
    main()
