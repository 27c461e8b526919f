"""Train 3DGS on the development scenes, encode at every rate point, and print quality, size and speed in one table.

    python benchmarks/photographs.py ../shared/data out/photographs
    python benchmarks/photographs.py ../shared/data out/photographs --scenes fox --iterations 7000

The bars are what another trainer (gsplat, default strategy) reached on the same files and steps, minus 0.2 dB. On mug
that was one run of a wide spread: four later runs of that trainer gave 28.5 to 29.9 dB.
Runs are those of `sw run`: finished ones are not repeated.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

from rich.console import Console
from rich.table import Table

SCENES = {"fox": ("--images", "images_2"), "mug": (), "lego": ()}
BARS = {"fox": 31.0, "mug": 29.4, "lego": 32.4}  # dB at 7,000 steps


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="folder that holds fox/, mug/ and lego/")
    parser.add_argument("out", type=Path, help="where the runs are kept")
    parser.add_argument("--scenes", default=",".join(SCENES), help="comma list (default: all three)")
    parser.add_argument("--iterations", type=int, default=7000, help="training steps (default: 7000)")
    parser.add_argument("--seed", type=int, default=0, help="of every random stream (default: 0)")
    args = parser.parse_args()
    for scene in args.scenes.split(","):
        subprocess.run(
            [sys.executable, "-m", "splatwizard_core", "run", "--method", "3dgs", "--scene", str(args.data / scene),
             *SCENES[scene], "--rate", "all", "--set", f"iterations={args.iterations}", "--set", "profile=stages",
             "--seed", str(args.seed), "--out", str(args.out)],
            check=True,
        )  # fmt: skip
        report(scene, args.out, bar=BARS[scene] if args.iterations == 7000 else None)


def report(scene: str, out: Path, bar: float | None) -> None:
    """Print one scene's rate points, and where its training time went."""
    records = [json.loads(path.read_text()) for path in out.glob(f"{scene}/3dgs/*/metrics.json")]
    records.sort(key=lambda r: r["file"]["bytes"])
    exact = records[-1]
    psnr = {r["rate"]: r["metrics"]["psnr"]["mean"] for r in records}
    table = Table(title=f"{scene}, {exact['protocol']['id']}", title_justify="left")
    for column in ("rate", "PSNR dB", "to exact dB", "SSIM", "bytes", "of exact", "B/Gaussian", "encode s", "decode s"):
        table.add_column(column, justify="right")
    for record in records:
        size, rate = record["file"]["bytes"], record["rate"]
        table.add_row(
            rate, f"{psnr[rate]:.3f}", f"{psnr[rate] - psnr[exact['rate']]:+.3f}",
            f"{record['metrics']['ssim']['mean']:.4f}", f"{size:,}", f"{size / exact['file']['bytes']:.3f}",
            f"{size / record['counts']['num_gaussians']:.1f}", f"{record['codec']['encode_s']:.2f}",
            f"{record['codec']['decode_s']:.2f}",
        )  # fmt: skip
    console = Console(width=120)
    console.print(table)
    best = psnr[exact["rate"]]
    if bar is not None:
        console.print(f"PSNR {best:.2f} dB, bar {bar:.1f} dB: {'reached' if best >= bar else 'NOT reached'}")
    train = exact["train"]
    console.print(
        f"{exact['counts']['num_gaussians']:,} Gaussians; {train['steps']} steps in {train['train_s']:.0f} s: "
        f"{train['steps'] / train['train_s']:.2f} it/s; "
        f"peak {train['peak_bytes'] / 1e9:.2f} GB ({train['memory_kind']})"
    )
    for stage, parts in (train["breakdown_s"] or {}).items():
        for part, seconds in parts.items():
            console.print(f"  {stage} {part:<12}{seconds:9.1f} s  {seconds / train['train_s']:6.1%}")


if __name__ == "__main__":
    main()
