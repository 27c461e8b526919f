"""Encode and decode seconds of methods for as many Gaussians as asked, with nothing pruned and nothing trained.

    python benchmarks/codec_seconds.py [--n 1000000] [--methods mesongs,c3dgs] [--device cpu] [--threads 2]

The Gaussians are those of benchmarks/scene.py, written as a .ply and given to `sw run --init` with 0 steps on the tiny
demo scene. Seconds are those of the record: encoding once, decoding in a fresh process; the whole command also makes
scores and codebooks: minutes for a million on a CPU. Shorter loops spare that where only the file matters:

    --set mesongs:codec.settings.vq_steps=10 --set c3dgs:color.iterations=5 --set c3dgs:shape.iterations=10

SH coefficients made here are noise in every direction, of which a search of codebooks leaves nothing out; those of a
trained scene (--ply) take less.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import torch
from sw_gaussians.ply import export_ply

from splatwizard_core.api import GaussianModel

sys.path.insert(0, str(Path(__file__).parent))
from scene import make_splats

# Of equal scores all go: of those that no view shows. Opacities differ, so that one Gaussian goes.
KEEP_ALL = {"mesongs": ["prune.pruner=opacity", "prune.tau=0"], "c3dgs": ["prune_threshold=-1"]}


def write(n: int, path: Path) -> None:
    """Write the scene as a trained model."""
    g = make_splats(n)
    assert g.sh is not None
    assert g.scales is not None
    assert g.quats is not None
    model = GaussianModel.from_tensors(
        g.means, g.sh.dc, g.sh.rest, torch.logit(g.opacities), g.scales.log(), g.quats, active_sh_degree=3
    )
    export_ply(model, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=int, default=1_000_000, help="Gaussians (default: 1,000,000)")
    parser.add_argument("--methods", default="mesongs,c3dgs", help="comma list of METHOD[@RATE]")
    parser.add_argument("--device", default="cpu", help="cpu or cuda (default: cpu)")
    parser.add_argument("--ply", type=Path, help="Gaussians of this file in place of the synthetic ones")
    parser.add_argument("--threads", type=int, default=0, help="CPU threads (default: all)")
    parser.add_argument("--set", action="append", default=[], metavar="METHOD:KEY=VALUE", help="for a method")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        ply = args.ply or Path(folder) / "scene.ply"
        if args.ply is None:
            write(args.n, ply)
        print(f"{ply.name}, {ply.stat().st_size:,} bytes as .ply, {args.device}")
        for asked in args.methods.split(","):
            method, _, rate = asked.partition("@")
            words = ["run", "--method", method, "--scene", "demo:tiny", "--init", str(ply), "--out", f"{folder}/out"]
            words += ["--rate", rate] if rate else []
            sets = ["iterations=0", f"threads={args.threads}", *KEEP_ALL.get(method, [])]
            sets += [each.partition(":")[2] for each in args.set if each.partition(":")[0] == method]
            words += ["--preset", "paper", "--device", args.device, *(w for each in sets for w in ("--set", each))]
            began = time.monotonic()
            done = subprocess.run(
                [sys.executable, "-m", "splatwizard_core", *words], capture_output=True, text=True, check=False
            )
            seconds = time.monotonic() - began
            if done.returncode != 0:
                print(f"{asked}: {done.stderr.strip().splitlines()[-1]}", flush=True)
                continue
            (record,) = Path(folder, "out").glob(f"*/{method}/*/metrics.json")
            facts = json.loads(record.read_text("utf-8"))
            codec = facts["codec"]
            print(
                f"{method:12} {facts['rate']}  {facts['counts']['num_gaussians']:>9,} Gaussians  "
                f"{facts['file']['bytes']:>11,} bytes  "
                f"encode {codec['encode_s']:6.2f} s  decode {codec['decode_s']:6.2f} s  whole command {seconds:6.1f} s",
                flush=True,
            )


if __name__ == "__main__":
    main()
