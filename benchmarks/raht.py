"""RAHT of many columns over many voxels: seconds for the plan, forward and inverse, beside one pass over the memory.

    python benchmarks/raht.py [--rows 1000000] [--columns 59] [--depth 20] [--device cpu] [--repeats 3]
    python benchmarks/raht.py --device cuda
    python benchmarks/raht.py --codec --rows 100000     # encode and decode seconds of codec `raht`, k-means of 5 passes

Points lie on a wavy surface, as those of a scene do. CPU seconds are of all threads (OMP_NUM_THREADS), so that other
programs do not count; wall seconds are the best of `repeats`. The ratio is to copying the matrix once.
"""

import argparse
import time

import numpy as np
import torch

from splatwizard_core.coding.container import ContainerReader, ContainerWriter
from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.plugins import load_plugins
from sw_codecs.positions import morton
from sw_codecs.transforms.raht import RahtPlan


def surface(rows, seed=0):
    """Points [rows,3] float32 on z = sin x cos y, a little off it."""
    r = np.random.default_rng(seed)
    x, y = r.uniform(-3, 3, (2, rows))
    z = np.sin(3 * x) * np.cos(2 * y) + r.normal(0, 0.01, rows)
    return np.stack([x, y, z], 1).astype(np.float32)


def codes_of(rows, depth):
    points = surface(rows).astype(np.float64)
    low, width = points.min(0), np.ptp(points, axis=0)
    cells = np.minimum((points - low) / width * 2**depth, 2**depth - 1).astype(np.int64)
    return np.unique(morton.encode(cells))


def timed(device, repeats, act):
    """Best wall seconds, CPU seconds of that, and the result."""
    best = None
    for _ in range(repeats):
        if device == "cuda":
            torch.cuda.synchronize()
        wall, cpu = time.perf_counter(), time.process_time()
        found = act()
        if device == "cuda":
            torch.cuda.synchronize()
        spent = time.perf_counter() - wall, time.process_time() - cpu
        best = spent if best is None or spent < best else best
    return *best, found


def transform(options):
    codes = codes_of(options.rows, options.depth)
    wall, cpu, plan = timed("cpu", options.repeats, lambda: RahtPlan(codes))
    values = torch.randn(len(codes), options.columns, dtype=getattr(torch, options.dtype)).to(options.device)
    plan.forward(values)  # moves the plan
    copy, _, _ = timed(options.device, options.repeats, values.clone)
    there, there_cpu, coefficients = timed(options.device, options.repeats, lambda: plan.forward(values))
    back, back_cpu, again = timed(options.device, options.repeats, lambda: plan.inverse(coefficients))
    error = float((again - values).abs().max())
    threads = torch.get_num_threads()
    print(f"{len(codes):,} voxels x {options.columns} {options.dtype}, {options.device}, {threads} threads")
    print(f"plan     {wall:8.4f} s  ({cpu:.4f} CPU s), once")
    print(f"forward  {there:8.4f} s  ({there_cpu:.4f} CPU s), {there / copy:.1f} copies")
    print(f"inverse  {back:8.4f} s  ({back_cpu:.4f} CPU s), {back / copy:.1f} copies")
    print(f"both     {there + back:8.4f} s; largest error {error:.1e}")


def codec(options):
    n, plugins = options.rows, load_plugins()
    g = torch.Generator().manual_seed(0)
    model = GaussianModel(
        torch.from_numpy(surface(n)), torch.randn(n, 1, 3, generator=g), 0.1 * torch.randn(n, 15, 3, generator=g),
        torch.randn(n, generator=g), torch.randn(n, 3, generator=g) - 5, torch.randn(n, 4, generator=g),
    ).to(options.device)  # fmt: skip
    make = plugins.gaussian_codecs.load("raht")

    def encode():
        writer = ContainerWriter("benchmark", 1)
        make(plugins, depth=options.depth, vq_training="kmeans", vq_steps=5).encode(model, writer)
        return writer.to_bytes()

    wall, cpu, data = timed(options.device, 1, encode)
    print(f"{n:,} Gaussians, {options.device}: {len(data):,} bytes")
    print(f"encode   {wall:8.4f} s  ({cpu:.4f} CPU s)")
    wall, cpu, _ = timed("cpu", options.repeats, lambda: make(plugins).decode(ContainerReader(data, "file")))
    print(f"decode   {wall:8.4f} s  ({cpu:.4f} CPU s), on the CPU")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", type=int, default=1_000_000)
    parser.add_argument("--columns", type=int, default=59)
    parser.add_argument("--depth", type=int, default=20)
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu")
    parser.add_argument("--dtype", choices=["float32", "float64"], default="float32")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--codec", action="store_true")
    options = parser.parse_args()
    (codec if options.codec else transform)(options)


if __name__ == "__main__":
    main()
