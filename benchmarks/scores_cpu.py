"""What scores cost on the CPU beside drawing the same view: one run prints one table.

    python benchmarks/scores_cpu.py [--n 250000] [--size 270x480] [--repeats 10] [--threads 1]

Each row is a view of an `accumulate` over --views of them; "of forward" compares with the forward pass of `standard`,
"of both" with its forward and backward pass. Times are minima.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

import torch

from splatwizard_core.rendering.rasterizer import RasterOptions, ScoreSpec
from sw_rasterizers.scoring import PupRasterizer
from sw_rasterizers.standard import StandardRasterizer

sys.path.insert(0, str(Path(__file__).parent))
from scene import make_splats, orbit_cameras

REQUESTS = {
    "hits": RasterOptions(scores=(ScoreSpec("h", "hits"),)),
    "hits + opacity_T (LightGaussian)": RasterOptions(scores=(ScoreSpec("h", "hits"), ScoreSpec("o", "opacity_T"))),
    "blend (MesonGS)": RasterOptions(scores=(ScoreSpec("b", "blend"),)),
    "hits + gamma, tested (TrimGS)": RasterOptions(
        scores=(ScoreSpec("h", "hits", rule="tested"), ScoreSpec("g", "gamma", rule="tested"))
    ),
    "grad_sq (Speedy-Splat)": RasterOptions(scores=(ScoreSpec("s", "grad_sq"),), clamp_grad="pass"),
    "Fisher (PUP)": RasterOptions(fisher=True, clamp_grad="pass"),
}


def fastest(run: Callable[[], object], repeats: int) -> float:
    """Seconds; the first call warms up."""
    run()
    best = float("inf")
    for _ in range(repeats):
        start = time.perf_counter()
        run()
        best = min(best, time.perf_counter() - start)
    return best


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--n", type=int, default=250_000, help="Gaussians")
    parser.add_argument("--size", default="270x480", help="height x width")
    parser.add_argument("--repeats", type=int, default=10)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--views", type=int, default=4)
    arguments = parser.parse_args()
    height, width = map(int, arguments.size.split("x"))
    torch.set_num_threads(arguments.threads)
    g, camera = make_splats(arguments.n, requires_grad=True), orbit_cameras(8, width, height)[0]
    views = [camera] * arguments.views
    print(f"{arguments.n} Gaussians, {width}x{height}, {arguments.threads} threads")

    def train() -> None:
        for x in g.tensors().values():
            x.grad = None
        StandardRasterizer().render(g, camera, RasterOptions()).image.sum().backward()

    with torch.no_grad():
        forward = fastest(lambda: StandardRasterizer().render(g, camera, RasterOptions()), arguments.repeats)
    both = fastest(train, arguments.repeats)
    print(f"{'forward of standard':34} {1e3 * forward:8.2f} ms\n{'forward and backward':34} {1e3 * both:8.2f} ms")
    for name, options in REQUESTS.items():
        seconds = fastest(
            lambda options=options: PupRasterizer().accumulate(g, views, options), arguments.repeats
        ) / len(views)
        ratios = f"{seconds / forward:5.2f} of forward {seconds / both:5.2f} of both"
        print(f"{name:34} {1e3 * seconds:8.2f} ms {ratios}")


if __name__ == "__main__":
    main()
