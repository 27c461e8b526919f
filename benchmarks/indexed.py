"""Memory and time of Gaussians that share colours and shapes: drawn from their codebooks, and gathered first.

    python benchmarks/indexed.py [--n 300000] [--rows 4096] [--size 270x480] [--device cpu] [--repeats 3]

`c3dgs` reads the codebooks; `gathered` is `GaussianInputs.gathered()` in front of `standard`, what any rasterizer that
does not read codebooks is given. Each runs in a process of its own. Memory: the most that a forward and a backward pass
add to what is there before, on a CPU of the resident set. Times are the least over --repeats.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path

import torch

from splatwizard_core.api import SH, GaussianInputs, RasterOptions
from splatwizard_native import MemoryMeter, synchronize
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
    """Peak bytes of both passes together, and the seconds of each."""
    g = sharing(n, rows, device)
    camera = orbit_cameras(8, width, height)[0].to(device)
    options = RasterOptions(background=torch.ones(3, device=device))
    rasterizer = IndexedRasterizer() if way == "c3dgs" else StandardRasterizer()
    found = {"bytes": 0.0, "forward_s": float("inf"), "backward_s": float("inf")}
    meter = MemoryMeter(device)
    for _ in range(repeats + 1):  # the first one loads the kernels and sorts the indices
        for tensor in g.tensors().values():
            tensor.grad = None
        meter.start()
        before = meter.current_bytes()
        start = time.perf_counter()
        image = rasterizer.render(g if way == "c3dgs" else g.gathered(), camera, options).image
        synchronize(torch.device(device))
        middle = time.perf_counter()
        image.square().sum().backward()
        synchronize(torch.device(device))
        end = time.perf_counter()
        peak = meter.peak_bytes() - (before if device == "cuda" else 0)
        found["bytes"] = peak if device == "cuda" else max(found["bytes"], peak)
        found["forward_s"] = min(found["forward_s"], middle - start)
        found["backward_s"] = min(found["backward_s"], end - middle)
    return found


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
    found = {}
    for way in WAYS:
        done = subprocess.run(
            [sys.executable, __file__, *sys.argv[1:], "--way", way], check=True, capture_output=True, text=True
        )
        found[way] = json.loads(done.stdout.splitlines()[-1])
        one = found[way]
        print(
            f"{way:9} {one['bytes'] / 1e6:8.0f} MB  {one['bytes'] / asked.n:6.0f} bytes a Gaussian  "
            f"forward {one['forward_s']:.3f} s  backward {one['backward_s']:.3f} s"
        )
    ratio = {key: found["gathered"][key] / found["c3dgs"][key] for key in found["c3dgs"]}
    print(
        f"gathered / c3dgs: memory {ratio['bytes']:.2f}, forward {ratio['forward_s']:.2f}, "
        f"backward {ratio['backward_s']:.2f}"
    )


if __name__ == "__main__":
    main()
