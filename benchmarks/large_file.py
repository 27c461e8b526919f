"""Memory and seconds of `sw compress` for a file of millions of Gaussians, made for this and deleted again.

    python benchmarks/large_file.py --gaussians 8600000 --size 60MB --folder /tmp [--limit N] [--json FILE]
    python benchmarks/large_file.py --ply garden.ply --size 60MB        # a file that is there

The Gaussians are those of `scene.py`, some scenes over each other, with scales as of one of so many. With --limit
two passes begin at so many, whatever the usual number is. Beside the file of 248 bytes a Gaussian the folder needs room
for twice as much. Figures by stage: seconds, seconds of CPU, and the most resident memory (Linux).
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scene import make_arrays
from sw_compress import compress, large
from sw_compress.stages import Stages
from sw_gaussians.ply_gaussians import file_parts

from splatwizard_core.tooling import peak_rss_bytes, reset_peak_rss, rss_bytes

ROWS_AT_ONCE = 1 << 18
KEPT = ("bytes", "pruned", "merged", "encodes", "tiles", "quality", "foreseen", "found", "tried", "peak_bytes")
"""Of the record of `sw compress`."""


def write_scene(path: Path, count: int) -> None:
    """Write a .ply of so many Gaussians, some at a time."""
    with path.open("wb") as file:
        for seed, start in enumerate(range(0, count, ROWS_AT_ONCE)):
            rows = min(ROWS_AT_ONCE, count - start)
            made = make_arrays(rows, seed)
            opacities, scales = made["opacities"].astype(np.float64), made["scales"] * math.sqrt(rows / count)
            logits = np.log(opacities / (1 - opacities)).astype(np.float32)
            sh = made["sh"]
            parts = file_parts(made["means"], sh[:, 0], sh[:, 1:], logits, np.log(scales), made["quats"])
            head = bytes(next(parts))
            if not start:
                file.write(head.replace(b"element vertex %d\n" % rows, b"element vertex %d\n" % count))
            for part in parts:
                file.write(part)


class Watched:
    """Memory and CPU seconds of each stage."""

    def __init__(self) -> None:
        self.stages: list[dict[str, Any]] = []

    @contextlib.contextmanager
    def timed(self, stages: Stages, name: str) -> Iterator[None]:
        reset_peak_rss()
        before, cpu, began = rss_bytes(), time.process_time(), time.perf_counter()
        with Stages.timed_alone(stages, name):  # type: ignore[attr-defined]
            yield
        row = {"stage": name, "seconds": time.perf_counter() - began, "cpu": time.process_time() - cpu,
               "before": before, "most": peak_rss_bytes()}  # fmt: skip
        self.stages.append(row)
        print("{stage:14s} {seconds:7.1f} s, {cpu:7.1f} s of CPU, at most {0:6.0f} MB".format(row["most"] / 1e6, **row),
              flush=True)  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description="Memory and seconds of one large file.")
    parser.add_argument("--gaussians", type=int, default=8_600_000)
    parser.add_argument("--size", default="60MB")
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()))
    parser.add_argument("--ply", type=Path, help="in place of one that is made")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--limit", type=int, help="Gaussians above which there are two passes")
    parser.add_argument("--json", type=Path)
    chosen = parser.parse_args()
    if chosen.limit is not None:
        large.LARGE = dict.fromkeys(large.LARGE, chosen.limit)
    watched = Watched()
    Stages.timed_alone = Stages.timed  # type: ignore[attr-defined]
    Stages.timed = lambda stages, name: watched.timed(stages, name)  # type: ignore[method-assign]
    with tempfile.TemporaryDirectory(dir=chosen.folder) as folder:
        path = chosen.ply or Path(folder) / "scene.ply"
        if chosen.ply is None:
            write_scene(path, chosen.gaussians)
        began, cpu = time.perf_counter(), time.process_time()
        done = compress(path, size=chosen.size, device=chosen.device, out=Path(folder) / "scene.swz", say=print)
        record = done.record
        found = {
            "gaussians": record["source"]["gaussians"], "bytes_before": path.stat().st_size,
            **{key: record.get(key) for key in KEPT},
            "left": record["gaussians"], "seconds": time.perf_counter() - began, "cpu": time.process_time() - cpu,
            "most": max(row["most"] for row in watched.stages), "stages": watched.stages,
        }  # fmt: skip
    print(json.dumps({key: value for key, value in found.items() if key != "stages"}))
    if chosen.json is not None:
        chosen.json.write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()
