"""Speed of the compiled CPU rasterizer, and against what: one run prints one table.

    python benchmarks/rasterize_cpu.py [--n 250000] [--size 270x480] [--repeats 10]

Compared with: the same source compiled without vectorisation (SW_LANES=1, -fno-tree-vectorize, otherwise the same
-O3 -march=native), the same with the compiler's own vectorisation, the pure-torch reference, and the roofline of
this machine (FMA rate and copy bandwidth measured at the start). Times are minima over --repeats, of the reference
over 2, of the scaling series over half as many.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from splatwizard_core.api import Rasterizer, RasterOptions
from splatwizard_native import operations
from sw_rasterizers import face, native
from sw_rasterizers.call import BACKWARD_STAGES, FORWARD_STAGES
from sw_rasterizers.standard import StandardRasterizer

sys.path.insert(0, str(Path(__file__).parent))
from scene import make_splats, orbit_cameras

BUILDS: dict[str, tuple[str, ...]] = {
    "packs": (),  # ours
    "scalar": ("-DSW_LANES=1", "-fno-tree-vectorize", "-fno-tree-slp-vectorize"),
    "compiler": ("-DSW_LANES=1",),
}
SH_COEFFICIENTS = 16
EXP_FLOPS = 13  # range reduction 3, polynomial 5 FMA


def measure(rasterizer: Rasterizer, n: int, width: int, height: int, threads: int, repeats: int, keep: int = 0) -> dict:
    """Fastest seconds of every stage, of both passes, and the counters; `keep` > 0 takes only the first Gaussians."""
    torch.set_num_threads(threads)
    g = make_splats(n, requires_grad=True)
    if keep:
        g = make_subset(g, keep)
    camera = orbit_cameras(8, width, height)[0]
    options = RasterOptions(background=torch.ones(3), grad2d=True)
    best: dict[str, float] = {}
    for repeat in range(repeats + 1):
        for x in g.tensors().values():
            x.grad = None
        start = time.perf_counter()
        result = rasterizer.render(g, camera, options)
        middle = time.perf_counter()
        gradient = torch.full_like(result.image, 1e-6)
        turn = time.perf_counter()
        result.image.backward(gradient)
        end = time.perf_counter()
        if repeat:  # the first one warms up
            seen = {**result.stats.stage_seconds, "forward": middle - start, "backward": end - turn}
            best = {k: min(v, best.get(k, v)) for k, v in seen.items()}
    return best


def make_subset(g, count: int):
    from sw_reference.testing.raster_scenes import permute_inputs

    subset = permute_inputs(g, torch.arange(count))
    for x in subset.tensors().values():
        x.detach_().requires_grad_()
    return subset


def counters(n: int, width: int, height: int) -> dict[str, int]:
    """N, V, P, E, B, X of specs: from a counting run, not from the timed ones."""
    g = make_splats(n)
    s = StandardRasterizer(count=True).render(g, orbit_cameras(8, width, height)[0], RasterOptions()).stats
    assert s.n_visible is not None
    assert s.n_pairs is not None
    assert s.n_evaluated is not None
    assert s.n_blended is not None
    return {"N": n, "V": s.n_visible, "P": s.n_pairs, "E": s.n_evaluated, "B": s.n_blended, "X": width * height}


def peaks() -> tuple[float, float]:
    """(flop/s, bytes/s) of one thread: a large matrix product, and a copy of 256 MB (read + write)."""
    torch.set_num_threads(1)
    a, b = torch.rand(1024, 1024), torch.rand(1024, 1024)
    source, target = torch.rand(1 << 26), torch.empty(1 << 26)

    def fastest(function) -> float:
        function()
        times = []
        for _ in range(7):
            start = time.perf_counter()
            function()
            times.append(time.perf_counter() - start)
        return min(times)

    return 2 * 1024**3 / fastest(lambda: a @ b), 8 * source.numel() / fastest(lambda: target.copy_(source))


def limits(c: dict[str, int], flops: float, bandwidth: float, *, evaluated: str) -> dict[str, float]:
    """Least seconds of each stage on one thread; `evaluated`: "E" as we do, or "B" if no pair were tried in vain."""
    K, C, N, V, P, B, X = SH_COEFFICIENTS, 3, c["N"], c["V"], c["P"], c["B"], c["X"]
    E = c[evaluated]
    work = {
        "project": (12 * N + V * (32 + 12 * K) + V * (32 + 4 * C), V * (290 + 2 * K * C)),
        "sort": (68 * V, 0),
        "bin": (26 * P, 30 * P),
        "blend": (40 * P + X * (4 * C + 8), (12 + EXP_FLOPS) * E + (10 + 2 * C) * B),
        "blend_backward": (76 * P + X * (4 * C + 8), (12 + EXP_FLOPS) * E + (45 + 4 * C) * B),
        # Gradients are dense: all N rows are written, V are read.
        "project_backward": ((44 + 12 * K) * (V + N) + 36 * P, 1500 * V),
    }
    return {stage: max(moved / bandwidth, done / flops) for stage, (moved, done) in work.items()}


def baseline(kind: str, arguments: argparse.Namespace) -> dict[str, float]:
    """The same measurement with another build, in a process of its own, which has one build."""
    command = [sys.executable, __file__, "--worker", kind, "--n", str(arguments.n), "--size", arguments.size]
    done = subprocess.run([*command, "--repeats", str(arguments.repeats)], capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(done.stderr)
    return json.loads(done.stdout.splitlines()[-1])


def exponent(xs: list[float], ys: list[float]) -> float:
    return float(np.polyfit(np.log(xs), np.log(ys), 1)[0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=int, default=250_000, help="Gaussians (default: 250000)")
    parser.add_argument("--size", default="270x480", help="image, WIDTHxHEIGHT (default: 270x480)")
    parser.add_argument("--repeats", type=int, default=10, help="timed runs, the fastest counts (default: 10)")
    parser.add_argument("--worker", choices=BUILDS, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    width, height = (int(v) for v in arguments.size.split("x"))
    n, repeats = arguments.n, arguments.repeats

    if arguments.worker:
        flags = (*native.MODULE.cflags, *BUILDS[arguments.worker])
        face.__getattr__ = operations(replace(native.MODULE, cflags=flags), face.__name__)
        print(json.dumps(measure(StandardRasterizer(), n, width, height, 1, repeats)))
        return

    flops, bandwidth = peaks()
    c = counters(n, width, height)
    print(f"{n} Gaussians, {width}x{height}; one thread: {flops / 1e9:.0f} Gflop/s (matrix product), "
          f"{bandwidth / 1e9:.1f} GB/s (copy)")  # fmt: skip
    counted = ", ".join(f"{k} {c[k]}" for k in "VPEB")
    print(f"visible Gaussians V, tile pairs P, evaluated E and blended B pixel pairs: {counted}")
    ours = measure(StandardRasterizer(), n, width, height, 1, repeats)
    two = measure(StandardRasterizer(), n, width, height, 2, repeats)
    others = {kind: baseline(kind, arguments) for kind in ("scalar", "compiler")}

    at_e, at_b = (limits(c, flops, bandwidth, evaluated=k) for k in "EB")
    print("\nmilliseconds, 1 thread unless said     ours  2 thr.  speed-up   scalar  ratio  compiler  ratio"
          "   roofline at E, at B")  # fmt: skip
    sums = {"forward": FORWARD_STAGES, "backward": BACKWARD_STAGES}
    for stage in (*FORWARD_STAGES, "forward", *BACKWARD_STAGES, "backward"):
        parts = sums.get(stage, (stage,))
        fractions = [sum(limit[p] for p in parts) / ours[stage] for limit in (at_e, at_b)]
        print(
            f"  {stage:30s} {1e3 * ours[stage]:10.2f} {1e3 * two[stage]:7.2f} {ours[stage] / two[stage]:9.2f}"
            + "".join(f" {1e3 * o[stage]:9.2f} {o[stage] / ours[stage]:5.1f}x" for o in others.values())
            + f"   {fractions[0]:8.0%} {fractions[1]:8.0%}"
        )
    print("\nnanoseconds per blended pair and thread     ours  2 threads   scalar  ratio")
    for name, stage in (("forward", "blend"), ("backward", "blend_backward")):
        scale = 1e9 / c["B"]
        print(
            f"  {name:36s} {ours[stage] * scale:9.2f} {2 * two[stage] * scale:9.2f} "
            f"{others['scalar'][stage] * scale:9.2f} {others['scalar'][stage] / ours[stage]:5.1f}x"
        )

    print_reference(repeats)
    print_scaling(arguments)


def print_reference(repeats: int) -> None:
    """Against pure torch, on a scene that it can draw in seconds."""
    from sw_reference.rasterizer import ReferenceRasterizer

    n, width, height = 4000, 135, 240
    ours = measure(StandardRasterizer(), n, width, height, 1, repeats)
    reference = measure(ReferenceRasterizer(), n, width, height, 1, 2)
    print(f"\npure-torch reference, {n} Gaussians, {width}x{height}, one thread")
    for stage in ("forward", "backward"):
        print(f"  {stage:10s} ours {1e3 * ours[stage]:7.2f} ms, reference {1e3 * reference[stage]:9.1f} ms: "
              f"{reference[stage] / ours[stage]:.0f}x")  # fmt: skip


def print_scaling(arguments: argparse.Namespace) -> None:
    """Cost over a decade of Gaussians (a growing part of one scene) and of pixels (the same view, larger)."""
    width, height = (int(v) for v in arguments.size.split("x"))
    counts = [round(arguments.n * 10 ** (-k / 3)) for k in (3, 2, 1, 0)]
    sides = [10 ** (k / 6) for k in (0, 1, 2, 3)]
    sizes = [(round(width * s), round(height * s)) for s in sides]
    repeats = max(3, arguments.repeats // 2)
    by_count = [
        measure(StandardRasterizer(), arguments.n, width, height, 1, repeats, keep=k if k < arguments.n else 0)
        for k in counts
    ]
    by_pixels = [measure(StandardRasterizer(), arguments.n, w, h, 1, repeats) for w, h in sizes]
    for what, xs, runs in (("N", counts, by_count), ("pixels", [w * h for w, h in sizes], by_pixels)):
        print(f"\nscaling in {what}")
        for x, run in zip(xs, runs, strict=True):
            print(f"  {x:10d}  forward {1e3 * run['forward']:8.2f} ms  backward {1e3 * run['backward']:8.2f} ms")
        # With the stages whose work is the pixels': the others depend on the Gaussians alone and flatten the sums.
        for stage in ("forward", "blend", "backward", "blend_backward"):
            print(f"  {stage}: time ~ {what}^{exponent(list(map(float, xs)), [r[stage] for r in runs]):.2f}")


if __name__ == "__main__":
    main()
