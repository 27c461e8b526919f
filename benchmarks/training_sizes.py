"""Files of trainings to a size, beside the plain training of each method: bytes over the size, time over plain time.

    python benchmarks/training_sizes.py --methods 3dgs,hac,c3dgs --shares 0.6,0.9 --out /tmp/sizes

Sizes are shares of the plain file's bytes, so that every method can be asked. Times are those of training and encoding,
corrected for cores that others had; of the training itself where the size is one of the file alone, and it is shared.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any


def run(method: str, out: Path, more: list[str]) -> tuple[dict[str, Any] | None, str]:
    """Return the record of a run, or None and the last line that it printed."""
    command = [sys.executable, "-m", "splatwizard_core", "run", "--method", method, "--out", str(out), *more]
    done = subprocess.run(command, capture_output=True, text=True)
    found = sorted(out.glob(f"*/{method}/*/metrics.json"))
    told = [line for line in done.stderr.splitlines() if line.strip()]
    warned = [line for line in told if "largest file" in line]
    if done.returncode or not found:
        return None, told[-1] if told else f"exit {done.returncode}"
    return json.loads(found[0].read_text()), (warned or [""])[-1]


def seconds(record: dict[str, Any]) -> float:
    """Return the seconds of training and encoding, on cores of their own: times the share of these that they got."""
    got = record["contended"]
    train, encode = float(record["train"]["train_s"]), float(record["codec"]["encode_s"])
    return train * got.get("train", 1.0) + encode * got.get("encode", 1.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--methods", required=True, help="names, separated by commas")
    parser.add_argument("--shares", default="0.6,0.9", help="of the plain file's bytes")
    parser.add_argument("--scene", default="demo:tiny")
    parser.add_argument("--out", type=Path, default=Path("out/sizes"))
    parser.add_argument("options", nargs="*", help="further options of `sw run`, after --")
    asked = parser.parse_args()
    usual = ["--scene", asked.scene, *asked.options]
    print(f"{'method':18} {'asked':>9} {'got':>9} {'ratio':>6} {'time':>5} {'PSNR':>6}")
    for method in asked.methods.split(","):
        plain, told = run(method, asked.out / "plain", usual)
        if plain is None:
            print(f"{method:18} plain run: {told}", flush=True)
            continue
        size = plain["file"]["bytes"]
        print(f"{method:18} {'-':>9} {size:9,} {'':>6} {1:5.2f} {plain['metrics']['psnr']['mean']:6.2f}", flush=True)
        for share in asked.shares.split(","):
            target = round(float(share) * size)
            sized = [*usual, "--size", str(target)]
            found, told = run(method, asked.out / "plain", sized)  # where the size is of the file alone
            if found is None and "another" in told:
                found, told = run(method, asked.out / share, sized)
            if found is None:
                print(f"{method:18} {target:9,} {told}", flush=True)
                continue
            got, ratio = found["file"]["bytes"], seconds(found) / seconds(plain)
            psnr = found["metrics"]["psnr"]["mean"]
            print(f"{method:18} {target:9,} {got:9,} {got / target:6.3f} {ratio:5.2f} {psnr:6.2f} {told}", flush=True)


if __name__ == "__main__":
    main()
