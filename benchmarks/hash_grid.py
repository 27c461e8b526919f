"""Lookup in Compact3DGS' hash grid and its gradient: the kernels and torch operations, milliseconds and peak memory.

    python benchmarks/hash_grid.py [--n 300000] [--device cpu] [--repeats 5]
    python benchmarks/hash_grid.py --device cuda --repeats 20

The grid is that of preset "paper": 16 levels of up to 2^19 entries of two numbers. Each way runs in this process, the
kernels first; on a GPU memory is that of torch's allocator above the grid and the places, on a CPU it is not told.
"""

from __future__ import annotations

import argparse
import time

import torch

from splatwizard_core.base.memory import synchronize
from sw_codecs.context.fast import grid_lookup
from sw_codecs.context.hash_grid import HashGrid


def measure(grid: HashGrid, x: torch.Tensor, repeats: int) -> tuple[float, float, float, torch.Tensor]:
    """Least seconds forward and backward, peak bytes above the start, the gradient."""
    device, least, peak = x.device, [float("inf")] * 2, 0.0
    weights = torch.randn(len(x), grid.width, generator=torch.Generator().manual_seed(1)).to(device)
    for _ in range(repeats + 1):
        grid.table.grad = None
        synchronize(device)
        if x.is_cuda:
            torch.cuda.reset_peak_memory_stats()
            before = torch.cuda.memory_allocated()
        start = time.perf_counter()
        found = grid(x)
        synchronize(device)
        middle = time.perf_counter()
        found.backward(weights)
        synchronize(device)
        least = [min(least[0], middle - start), min(least[1], time.perf_counter() - middle)]
        if x.is_cuda:
            peak = torch.cuda.max_memory_allocated() - before
    assert grid.table.grad is not None
    return *least, peak, grid.table.grad


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--n", type=int, default=300_000)
    parser.add_argument("--device", default="cpu", choices=["cpu", "cuda"])
    parser.add_argument("--repeats", type=int, default=5)
    asked = parser.parse_args()
    generator = torch.Generator().manual_seed(0)
    grid = HashGrid.real_grid(finest=16 * 1.447**15, generator=generator).to(asked.device)
    # As Gaussians are: most of them close to surfaces, here around the middle of the contracted cube.
    x = (0.5 + 0.1 * torch.randn(asked.n, 3, generator=generator)).clamp(0, 1).to(asked.device)
    print(f"{asked.n:,} places, {len(grid.levels)} levels, {len(grid.table):,} entries, {asked.device}")
    kernels = grid_lookup.fits(grid, x, grid.table)
    found = {}
    for way in ("kernels", "torch"):
        if way == "kernels" and not kernels:
            print("no compiled kernels")
            continue
        if way == "torch":
            grid_lookup.fits = lambda *_: False
        forward, backward, peak, _ = found[way] = measure(grid, x, asked.repeats)
        told = f"  {peak / 1e6:8.1f} MB" if asked.device == "cuda" else ""
        print(f"{way:8} forward {1e3 * forward:8.3f} ms  backward {1e3 * backward:8.3f} ms{told}")
    if kernels:
        apart = float((found["kernels"][3] - found["torch"][3]).norm() / found["torch"][3].norm())
        ratios = [found["torch"][i] / found["kernels"][i] for i in range(2)]
        print(f"torch / kernels: forward {ratios[0]:.1f}, backward {ratios[1]:.1f}; gradients {apart:.1e} apart")


if __name__ == "__main__":
    main()
