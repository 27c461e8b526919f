"""Cost of scores of Gaussians beside drawing the same view: one run prints one table.

    python benchmarks/scores.py [--device cpu] [--n 250000] [--size 270x480] [--repeats 10] [--threads 1] [--views 4]
    python benchmarks/scores.py --device cuda --n 1000000 --size 1080x1920

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
from sw_reference.testing.raster_scenes import cast_inputs, with_tensors

from splatwizard_core.api import RasterOptions, ScoreSpec
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
    "removal": RasterOptions(scores=(ScoreSpec("d", "removal"),)),
    "Fisher (PUP)": RasterOptions(fisher=True, clamp_grad="pass"),
}


def fastest(run: Callable[[], object], repeats: int, device: str) -> float:
    """Seconds; the first call warms up."""

    def wait() -> None:
        if device == "cuda":
            torch.cuda.synchronize()

    run()
    best = float("inf")
    for _ in range(repeats):
        wait()
        start = time.perf_counter()
        run()
        wait()
        best = min(best, time.perf_counter() - start)
    return best


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", default="cpu", choices=["cpu", "cuda"])
    parser.add_argument("--n", type=int, default=250_000, help="Gaussians")
    parser.add_argument("--size", default="270x480", help="height x width")
    parser.add_argument("--repeats", type=int, default=10)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--views", type=int, default=4)
    arguments = parser.parse_args()
    height, width = map(int, arguments.size.split("x"))
    torch.set_num_threads(arguments.threads)
    g, camera = cast_inputs(make_splats(arguments.n), device=arguments.device), orbit_cameras(8, width, height)[0]
    views = [camera] * arguments.views
    leaves = with_tensors(g, {k: x.clone().requires_grad_() for k, x in g.tensors().items() if x.is_floating_point()})

    def forward() -> None:
        with torch.no_grad():
            StandardRasterizer().render(g, camera, RasterOptions())

    def forward_and_backward() -> None:
        for x in leaves.tensors().values():
            x.grad = None
        StandardRasterizer().render(leaves, camera, RasterOptions()).image.sum().backward()

    def measure(run: Callable[[], object]) -> float:
        return fastest(run, arguments.repeats, arguments.device)

    place = f"{arguments.threads} threads" if arguments.device == "cpu" else torch.cuda.get_device_name()
    print(f"{arguments.n} Gaussians, {width}x{height}, {place}")
    one, both = measure(forward), measure(forward_and_backward)
    print(f"{'forward of standard':34} {1e3 * one:8.2f} ms\n{'forward and backward':34} {1e3 * both:8.2f} ms")
    for name, options in REQUESTS.items():
        seconds = measure(lambda options=options: StandardRasterizer().accumulate(g, views, options)) / len(views)
        ratios = f"{seconds / one:5.2f} of forward {seconds / both:5.2f} of both"
        print(f"{name:34} {1e3 * seconds:8.2f} ms {ratios}")


if __name__ == "__main__":
    main()
