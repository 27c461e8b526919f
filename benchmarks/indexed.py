"""Memory and time of Gaussians that share colours and shapes: read from their tables, and gathered first.

    python benchmarks/indexed.py [--n 300000] [--rows 4096] [--size 270x480] [--device cpu] [--repeats 3]
    python benchmarks/indexed.py --device cuda --n 1000000 --size 822x1237 --repeats 20

`c3dgs` reads the tables in its kernels; `gathered` is `GaussianInputs.gathered()` in front of `standard`, what any
rasterizer that reads no tables is given. Each runs in a process of its own. Memory: the most that is there during the
forward pass, and during the backward pass, above what is there before both (the inputs and their gradients' place are
not counted), on a CPU of the resident set. Times are the least over --repeats. Last: the differences of images and
gradients.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import torch

from splatwizard_core.api import SH, GaussianInputs, RasterOptions
from splatwizard_core.base.memory import MemoryMeter, synchronize
from sw_rasterizers.standard import StandardRasterizer
from sw_rasterizers.variants import IndexedRasterizer

sys.path.insert(0, str(Path(__file__).parent))
from scene import make_splats, orbit_cameras

WAYS = ("c3dgs", "gathered")


def sharing(n: int, rows: int, device: str) -> GaussianInputs:
    """Gaussians of the benchmark scene, their colours and shapes drawn from the first `rows`."""
    g, generator = make_splats(n), torch.Generator().manual_seed(1)
    index = [torch.randint(rows, (n,), generator=generator).to(device) for _ in range(2)]
    leaves = {
        "means": g.means, "opacities": g.opacities, "scales": g.scales[:rows], "quats": g.quats[:rows],
        "scale_factors": torch.ones(n), "codebook": g.sh.to_dense()[:rows],
    }  # fmt: skip
    own = {name: each.detach().clone().to(device).requires_grad_(True) for name, each in leaves.items()}
    colors = SH(codebook=own.pop("codebook"), indices=index[0], active_degree=3)
    return GaussianInputs(**own, geom_indices=index[1], sh=colors)


def measure(way: str, n: int, rows: int, width: int, height: int, device: str, repeats: int) -> dict[str, float]:
    """Peak bytes and least seconds of each pass."""
    g = sharing(n, rows, device)
    camera = orbit_cameras(8, width, height)[0].to(device)
    options = RasterOptions(background=torch.ones(3, device=device))
    rasterizer = IndexedRasterizer() if way == "c3dgs" else StandardRasterizer()
    found = {"forward_bytes": 0.0, "backward_bytes": 0.0, "forward_s": float("inf"), "backward_s": float("inf")}
    meter = MemoryMeter(device)
    on_cpu = device == "cpu"
    for _ in range(repeats + 1):  # the first one loads the kernels and sorts the indices
        for tensor in g.tensors().values():
            tensor.grad = None
        meter.start()
        before = meter.current_bytes()
        start = time.perf_counter()
        image = rasterizer.render(g if way == "c3dgs" else g.gathered(), camera, options).image
        loss = image.square().sum()
        synchronize(torch.device(device))
        middle = time.perf_counter()
        forward, kept = meter.peak_bytes() - before, meter.current_bytes() - before
        meter.start()
        again = time.perf_counter()
        loss.backward()
        synchronize(torch.device(device))
        end = time.perf_counter()
        backward = meter.peak_bytes() + (kept if on_cpu else -before)
        # A CPU's allocator gives memory back late or never: what is there already counts in the first round alone.
        found["forward_bytes"] = max(found["forward_bytes"], forward) if on_cpu else forward
        found["backward_bytes"] = max(found["backward_bytes"], backward) if on_cpu else backward
        found["forward_s"] = min(found["forward_s"], middle - start)
        found["backward_s"] = min(found["backward_s"], end - again)
    return found


def differences(n: int, rows: int, width: int, height: int, device: str) -> str:
    """Largest difference of the images of the two ways, and relative norms of those of their gradients."""
    camera = orbit_cameras(8, width, height)[0].to(device)
    options = RasterOptions(background=torch.ones(3, device=device))
    found = {}
    for way in WAYS:
        g = sharing(n, rows, device)
        rasterizer = IndexedRasterizer() if way == "c3dgs" else StandardRasterizer()
        image = rasterizer.render(g if way == "c3dgs" else g.gathered(), camera, options).image
        image.square().sum().backward()
        found[way] = image.detach(), {name: x.grad for name, x in g.tensors().items() if x.grad is not None}
    apart = float((found["c3dgs"][0] - found["gathered"][0]).abs().max())
    of = [
        f"{name} {float((x - found['c3dgs'][1][name]).norm() / x.norm()):.1e}"
        for name, x in found["gathered"][1].items()
    ]
    return f"image {apart:.1e}; gradients, relative: {', '.join(of)}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--n", type=int, default=300_000)
    parser.add_argument("--rows", type=int, default=4096)
    parser.add_argument("--size", default="270x480", help="HEIGHTxWIDTH")
    parser.add_argument("--device", default="cpu", choices=["cpu", "cuda"])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--way", choices=WAYS, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    height, width = map(int, asked.size.split("x"))
    if asked.way:
        print(json.dumps(measure(asked.way, asked.n, asked.rows, width, height, asked.device, asked.repeats)))
        return
    print(f"{asked.n:,} Gaussians, {asked.rows:,} colours and shapes, {asked.size}, {asked.device}")
    # Memory that is freed goes back at once: the passes would else begin in what making the scene left behind.
    env = {**os.environ, "MALLOC_MMAP_THRESHOLD_": "65536"}
    found = {}
    for way in WAYS:
        done = subprocess.run(
            [sys.executable, __file__, *sys.argv[1:], "--way", way], check=True, capture_output=True, text=True, env=env
        )
        found[way] = json.loads(done.stdout.splitlines()[-1])
        one = found[way]
        parts = [
            f"{of} {one[of + '_bytes'] / 1e6:7.1f} MB ({one[of + '_bytes'] / asked.n:4.0f} a Gaussian) "
            f"{1e3 * one[of + '_s']:8.2f} ms"
            for of in ("forward", "backward")
        ]
        print(f"{way:9} {'   '.join(parts)}")
    ratio = {key: found["gathered"][key] / found["c3dgs"][key] for key in found["c3dgs"]}
    print(
        "gathered / c3dgs: "
        + ", ".join(
            f"{of} memory {ratio[of + '_bytes']:.2f}, time {ratio[of + '_s']:.2f}" for of in ("forward", "backward")
        )
    )
    print(f"apart: {differences(min(asked.n, 100_000), asked.rows, width, height, asked.device)}")


if __name__ == "__main__":
    main()
