"""Cost of surfels beside ellipsoids: `2dgs` and `standard` on the same splats, for the same outputs.

    python benchmarks/rasterize_surfels.py [--n 250000] [--size 270x480] [--threads 1] [--repeats 10]
    python benchmarks/rasterize_surfels.py --device cuda --n 1000000 --size 1920x1080

The scene is that of benchmarks/scene.py; the surfels are its Gaussians without their third, thinnest axis. Turns
alternate, so that whatever else the machine does meets both; times are minima. The last rows have no counterpart: only
surfels have normals and a distortion. The load that is printed is that of the machine before the first turn.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from dataclasses import replace
from pathlib import Path

import torch
from sw_reference.testing.raster_scenes import cast_inputs, with_tensors

from splatwizard_core.api import Camera, GaussianInputs, Rasterizer, RasterOptions
from sw_rasterizers.standard import StandardRasterizer
from sw_rasterizers.surfel import SurfelRasterizer

sys.path.insert(0, str(Path(__file__).parent))
from scene import make_splats, orbit_cameras

DEPTHS = frozenset({"accumulated", "expected", "median"})
OUTPUTS = {
    "image": RasterOptions(grad2d=True),
    "image, alpha, 3 depths": RasterOptions(grad2d=True, alpha=True, depth=DEPTHS),
    "all, normals, distortion": RasterOptions(grad2d=True, alpha=True, depth=DEPTHS, normals=True, distortion=True),
}


def now(device: torch.device) -> float:
    """Seconds, after all that was asked of the device is done."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def step(rasterizer: Rasterizer, g: GaussianInputs, camera: Camera, options: RasterOptions) -> dict[str, float]:
    """Seconds of both passes and of the stages."""
    for x in g.tensors().values():
        x.grad = None
    device = g.means.device
    start = now(device)
    result = rasterizer.render(g, camera, options)
    middle = now(device)
    maps = [result.image, *result.depth.values()]
    maps += [x for x in (result.alpha, result.normals, result.distortion) if x is not None]
    gradients = [torch.full_like(x, 1e-6) for x in maps]
    turn = now(device)
    torch.autograd.backward(maps, gradients)
    end = now(device)
    return {**result.stats.stage_seconds, "forward": middle - start, "backward": end - turn}


def leaves(g: GaussianInputs, device: str) -> GaussianInputs:
    moved = cast_inputs(g, device=device)
    return with_tensors(moved, {k: x.detach().clone().requires_grad_() for k, x in moved.tensors().items()})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=int, default=250_000, help="Gaussians (default: 250000)")
    parser.add_argument("--size", default="270x480", help="image, WIDTHxHEIGHT (default: 270x480)")
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"))
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=10, help="timed turns, the fastest counts (default: 10)")
    parser.add_argument("--stages", action="store_true", help="print every stage (CPU)")
    arguments = parser.parse_args()
    width, height = (int(v) for v in arguments.size.split("x"))
    torch.set_num_threads(arguments.threads)
    camera = orbit_cameras(8, width, height)[0]
    ellipsoids = leaves(make_splats(arguments.n), arguments.device)
    assert ellipsoids.scales is not None
    flat = make_splats(arguments.n)
    flat = leaves(replace(flat, scales=ellipsoids.scales.detach()[:, :2]), arguments.device)

    load = ", ".join(f"{x:.1f}" for x in os.getloadavg())
    place = f"{arguments.threads} threads of {os.cpu_count()} CPUs; load {load}"
    if arguments.device == "cuda":
        place = torch.cuda.get_device_name()
    print(f"{arguments.n} splats, {width}x{height}, {place}")
    with torch.no_grad():
        for name, counting, g in (
            ("standard", StandardRasterizer(count=True), ellipsoids),
            ("2dgs", SurfelRasterizer(count=True), flat),
        ):
            s = counting.render(g, camera, RasterOptions()).stats
            print(f"  {name:9s} visible {s.n_visible}, tile pairs {s.n_pairs}, evaluated {s.n_evaluated}, "
                  f"blended {s.n_blended} pixel pairs")  # fmt: skip
    for outputs, options in OUTPUTS.items():
        contenders = {"2dgs": (SurfelRasterizer(), flat)}
        if not options.normals:
            contenders["standard"] = (StandardRasterizer(), ellipsoids)
        best: dict[str, dict[str, float]] = {name: {} for name in contenders}
        for turn in range(arguments.repeats + 1):
            for name, (rasterizer, g) in contenders.items():
                seen = step(rasterizer, g, camera, options)
                if turn:  # the first one warms up
                    best[name] = {k: min(v, best[name].get(k, v)) for k, v in seen.items()}
        for times in best.values():
            times["both"] = times["forward"] + times["backward"]
        print(f"\n{outputs}: milliseconds" + ("      2dgs  standard  ratio" if len(best) == 2 else "      2dgs"))
        for stage in best["2dgs"] if arguments.stages else ("forward", "backward", "both"):
            line = f"  {stage:28s} {1e3 * best['2dgs'][stage]:13.2f}"
            if "standard" in best:
                other = best["standard"][stage]
                line += f" {1e3 * other:9.2f} {best['2dgs'][stage] / other:5.2f}x"
            print(line)


if __name__ == "__main__":
    main()
