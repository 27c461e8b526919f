"""Seconds and bytes of every format, to write and to read, of many Gaussians at SH degree 3.

    python benchmarks/interchange.py --gaussians 1000000

Values are random but shaped like those of a trained scene: clustered centres, most SH coefficients small. The best of
--repeats; .sog, whose palette takes long, once, and only with --sog. Needs sw-interchange.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from sw_interchange import GaussianScene, read, write

FORMATS: dict[str, dict[str, Any]] = {
    "ply": {}, "splat": {}, "spz": {}, "spz v4": {"version": 4}, "compressed.ply": {}, "glb": {},
}  # fmt: skip


def trained_like(n: int, seed: int = 0) -> GaussianScene:
    """A scene whose values spread as those of a trained one do."""
    rng = np.random.default_rng(seed)

    def normal(*shape: int) -> np.ndarray:
        return rng.standard_normal(shape, dtype=np.float32)

    quats = normal(n, 4)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    centres = 5 * normal(1000, 3)
    return GaussianScene(
        means=centres[rng.integers(1000, size=n)] + 0.3 * normal(n, 3),
        log_scales=-4.5 + normal(n, 3),
        quats=quats,
        opacity_logits=2.5 * normal(n) - 1,
        sh_dc=0.8 * normal(n, 3),
        sh_rest=0.06 * normal(n, 15, 3) * np.abs(normal(n, 1, 1)),
    )


def best(work: Callable[[], object], repeats: int) -> float:
    """Least seconds of several runs."""
    seconds = []
    for _ in range(repeats):
        began = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - began)
    return min(seconds)


def main() -> int:
    """Measure, and print a line for each format and a JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--gaussians", type=int, default=1_000_000)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--formats", nargs="*", default=list(FORMATS))
    parser.add_argument("--sog", action="store_true")
    arguments = parser.parse_args()
    scene = trained_like(arguments.gaussians)
    rows = {}
    with tempfile.TemporaryDirectory() as folder:
        for name in [*arguments.formats, *(["sog"] if arguments.sog else [])]:
            repeats = 1 if name == "sog" else arguments.repeats
            path, options = Path(folder) / f"scene.{name.split()[0]}", FORMATS.get(name, {})
            write_s = best(lambda path=path, options=options: write(scene, path, **options), repeats)
            read_s = best(lambda path=path: read(path), repeats)
            size = path.stat().st_size
            rows[name] = {"write_s": write_s, "read_s": read_s, "bytes": size}
            print(f"{name}: write {write_s:.3f} s, read {read_s:.3f} s, {size:,} bytes, "
                  f"{size / arguments.gaussians:.1f} a Gaussian", flush=True)  # fmt: skip
    print(json.dumps({"gaussians": arguments.gaussians, "formats": rows}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
