"""Damaged files of one format by the thousand: nothing but clear errors or sound scenes, in bounded memory and time.

    python benchmarks/interchange_fuzz.py spz --files 100000

Prints what came of them, the slowest, and how far the peak of the resident memory rose. Formats: ply, splat,
compressed-ply, ksplat, gltf, spz, spz-v4, sog; without one, all. Needs sw-interchange; one process, no network.
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from interchange_files import mutants, samples
from sw_interchange import Limits, decode

from splatwizard_core.api import SplatwizardError

LIMITS = Limits(max_gaussians=1 << 20, max_output_bytes=1 << 28)
MEMORY = 256 << 20


def peak() -> int:
    """Peak of the resident set, bytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10


def attack(name: str, files: int, seed: int) -> bool:
    """Decode `files` damaged copies; print the tally. False if an error had two lines, or memory rose too far."""
    sample = samples()[name]
    decode(sample.data, sample.format)  # imports what is imported late
    before, scenes, slowest, bad = peak(), 0, 0.0, 0
    for data in mutants(sample, files, seed):
        began = time.perf_counter()
        try:
            scene = decode(data, sample.format, limits=LIMITS)
        except SplatwizardError as error:
            bad += "\n" in str(error) or len(str(error)) > 400
        else:
            scenes += 1
            bad += not (np.isfinite(scene.means).all() and np.isfinite(scene.quats).all())
        slowest = max(slowest, time.perf_counter() - began)
    rise = peak() - before
    print(f"{name}: {files:,} files, {files - scenes:,} refused, {scenes:,} read, {bad} bad, slowest {slowest:.3f} s, "
          f"memory +{rise / 1e6:.1f} MB", flush=True)  # fmt: skip
    return not bad and rise < MEMORY


def main() -> int:
    """Run; status 1 if anything but clear errors and sound scenes came of it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("formats", nargs="*", metavar="FORMAT", help="[default: all]")
    parser.add_argument("--files", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    sound = [attack(name, arguments.files, arguments.seed) for name in arguments.formats or samples()]
    return int(not all(sound))


if __name__ == "__main__":
    sys.exit(main())
