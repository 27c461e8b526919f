"""Speed of the compiled CUDA rasterizer beside gsplat in the same process: one run prints one table.

    python benchmarks/rasterize_cuda.py [--scenes 200000,1000000,3000000] [--sizes 1237x822,1920x1080] [--repeats 40]
    python benchmarks/rasterize_cuda.py --inference    the approximate rasterizers beside the exact one, forward only
    python benchmarks/rasterize_cuda.py --check        values and gradients against the CPU's kernels
    compute-sanitizer --tool memcheck python benchmarks/rasterize_cuda.py --sanitize      (also --tool racecheck)

Scenes of benchmarks/scene.py, eight orbit views in turn, spherical harmonics of degree 3, activated inputs, near 0.2,
float32; medians over --repeats with CUDA events, after as many turns to warm up. Forward under no_grad;
forward + backward of sum(image * fixed random weight) with gradients of all five inputs. `ref` are the times on an H200
that this library set out to beat (gsplat after 1.5.3), scaled by what gsplat 1.5.3 takes here over what it took there,
both with packed=False, its faster mode; without gsplat they are unscaled. Peak memory is above the inputs, with the
gradients. --inference also says how far the approximate images are from the exact ones, the worst of eight views, and
`bar`, the fastest approximate rasterizer known on an H200; it fails where the images do not agree.
"""

from __future__ import annotations

import argparse
import functools
import math
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import torch

from splatwizard_core.api import SH, Camera, GaussianInputs, RasterOptions
from sw_rasterizers.call import BACKWARD_STAGES, FORWARD_STAGES
from sw_rasterizers.inference import FlashRasterizer, TensorCoreRasterizer
from sw_rasterizers.standard import StandardRasterizer

sys.path.insert(0, str(Path(__file__).parent))
from scene import make_splats, orbit_cameras

VIEWS = 8
# H200, milliseconds: gsplat 1.5.3 forward, forward + backward; the gsplat that came after it.
REFERENCE = {
    (200_000, "1237x822"): ((0.75, 1.87), (0.65, 1.76)),
    (200_000, "1920x1080"): ((1.14, 3.02), (1.07, 2.85)),
    (1_000_000, "1237x822"): ((1.18, 3.15), (1.02, 2.94)),
    (1_000_000, "1920x1080"): ((1.52, 4.25), (1.30, 4.00)),
    (3_000_000, "1237x822"): ((2.24, 5.96), (2.08, 5.84)),
    (3_000_000, "1920x1080"): ((2.39, 6.79), (2.18, 6.72)),
}
# H200, milliseconds: the fastest forward-only rasterizer known, of 16-bit or 8-bit precision.
FASTEST_APPROXIMATE = {
    (200_000, "1237x822"): 0.43,
    (200_000, "1920x1080"): 0.58,
    (1_000_000, "1237x822"): 0.84,
    (1_000_000, "1920x1080"): 1.02,
    (3_000_000, "1237x822"): 1.51,
    (3_000_000, "1920x1080"): 1.58,
}
SH_COEFFICIENTS = 16


def scene_on(n: int, device: str) -> GaussianInputs:
    """The benchmark's splats with dense spherical harmonics, leaves that want gradients."""
    g = make_splats(n)
    assert g.sh is not None
    assert g.sh.dc is not None
    assert g.sh.rest is not None
    sh = torch.cat([g.sh.dc, g.sh.rest], dim=1)
    moved = [x.to(device) for x in (g.means, g.opacities, g.scales, g.quats, sh)]
    for x in moved:
        x.requires_grad_()
    return GaussianInputs(*moved[:4], sh=SH(dense=moved[4]))


def leaves(g: GaussianInputs) -> list[torch.Tensor]:
    return list(g.tensors().values())


Draw = Callable[[GaussianInputs, Camera], torch.Tensor]


def ours() -> Draw:
    rasterizer, options = StandardRasterizer(), RasterOptions()
    return lambda g, cam: rasterizer.render(g, cam, options).image


def gsplats(packed: bool) -> Draw | None:
    try:
        from gsplat import rasterization
    except ImportError:
        return None
    placed: dict[int, tuple[torch.Tensor, torch.Tensor]] = {}

    def draw(g: GaussianInputs, cam: Camera) -> torch.Tensor:
        if id(cam) not in placed:
            view = torch.eye(4)
            view[:3, :3], view[:3, 3] = cam.R, cam.tau
            K = torch.tensor([[cam.fx, 0, cam.cx], [0, cam.fy, cam.cy], [0, 0, 1]])
            placed[id(cam)] = view[None].cuda(), K[None].cuda()
        view, K = placed[id(cam)]
        assert g.sh is not None
        image, _, _ = rasterization(
            g.means, g.quats, g.scales, g.opacities, g.sh.dense, view, K, cam.width, cam.height,
            near_plane=0.2, sh_degree=3, packed=packed,
        )  # fmt: skip
        return image[0].permute(2, 0, 1)

    return draw


def milliseconds(step: Callable[[int], object], repeats: int) -> float:
    """Median over the repeats of the time of one step on the device."""
    for i in range(min(repeats, 2 * VIEWS)):
        step(i)
    marks = [(torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)) for _ in range(repeats)]
    torch.cuda.synchronize()
    for i, (start, end) in enumerate(marks):
        start.record()
        step(i)
        end.record()
    torch.cuda.synchronize()
    return statistics.median(start.elapsed_time(end) for start, end in marks)


def measure(draw: Draw, g: GaussianInputs, cameras: list[Camera], repeats: int) -> tuple[float, float, float]:
    """(forward ms, forward + backward ms, peak MiB above the inputs of forward + backward)."""
    weight = torch.rand(3, cameras[0].height, cameras[0].width, generator=torch.Generator().manual_seed(0)).cuda()

    def forward(i: int) -> None:
        with torch.no_grad():
            draw(g, cameras[i % VIEWS])

    def both(i: int) -> None:
        for x in leaves(g):
            x.grad = None
        (draw(g, cameras[i % VIEWS]) * weight).sum().backward()

    times = milliseconds(forward, repeats), milliseconds(both, repeats)
    for x in leaves(g):
        x.grad = None
    torch.cuda.synchronize()
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    both(0)
    torch.cuda.synchronize()
    peak = torch.cuda.max_memory_allocated() - before
    for x in leaves(g):
        x.grad = None
    return *times, peak / 2**20


def stages(g: GaussianInputs, cameras: list[Camera]) -> tuple[dict[str, float], dict[str, float]]:
    """(milliseconds of each stage, counts N V P E B X), medians over the views; from runs that count and wait."""
    rasterizer = StandardRasterizer(count=True)
    rows: list[dict[str, float]] = []
    counts: list[dict[str, float]] = []
    for turn in range(2):
        for cam in cameras:
            result = rasterizer.render(g, cam, RasterOptions())
            result.image.sum().backward()
            s = result.stats
            if turn:
                rows.append({k: 1e3 * v for k, v in s.stage_seconds.items()})
                named = {"V": s.n_visible, "P": s.n_pairs, "E": s.n_evaluated, "B": s.n_blended, "X": s.n_pixels}
                counts.append({k: float(v or 0) for k, v in named.items()})
    for x in leaves(g):
        x.grad = None

    def middle(of: list[dict[str, float]]) -> dict[str, float]:
        return {k: statistics.median(r[k] for r in of) for k in of[0]}

    return middle(rows), {"N": float(len(g)), **middle(counts)}


def peaks() -> tuple[float, float, float]:
    """(flop/s, bytes/s, exponentials/s): the first from clock and cores, the second measured with a copy of 4 GiB."""
    properties = torch.cuda.get_device_properties(0)
    clock = 1e3 * getattr(properties, "clock_rate", 1_980_000)
    cores = properties.multi_processor_count
    source, target = torch.rand(1 << 29, device="cuda"), torch.empty(1 << 29, device="cuda")
    seconds = 1e-3 * milliseconds(lambda _: target.copy_(source), 10)
    return cores * 256 * clock, 8 * source.numel() / seconds, cores * 16 * clock


def limits(c: dict[str, float], flops: float, bandwidth: float, exps: float) -> dict[str, float]:
    """Least milliseconds of each stage by bytes, operations and exponentials."""
    K, C, N, V, P, E, B, X = SH_COEFFICIENTS, 3, c["N"], c["V"], c["P"], c["E"], c["B"], c["X"]
    work = {
        "project": (12 * N + V * (32 + 12 * K) + V * (32 + 4 * C), V * (290 + 2 * K * C), 0),
        "sort": (68 * V, 0, 0),
        "bin": (4 * P + 26 * P, 30 * P, 0),
        "blend": (40 * P + X * (4 * C + 8), 12 * E + (10 + 2 * C) * B, B),
        "blend_backward": (40 * P + 36 * P + X * (4 * C + 8), 12 * E + (45 + 4 * C) * B, 2 * B),
        # Gradients are dense: all N rows are written, V are read.
        "project_backward": ((44 + 12 * K) * (V + N) + 36 * V, 1500 * V, 0),
    }
    return {s: 1e3 * max(b / bandwidth, f / flops, x / exps) for s, (b, f, x) in work.items()}


def table(arguments: argparse.Namespace) -> None:
    rivals = {name: draw for name, draw in (("gsplat", gsplats(False)), ("packed", gsplats(True))) if draw}
    top = peaks()
    print(f"{torch.cuda.get_device_name(0)}, torch {torch.__version__}, copy {top[1] / 1e12:.2f} TB/s")
    print("milliseconds: forward, forward + backward; MiB: peak above the inputs, gradients included")
    ratios: dict[str, list[tuple[float, float]]] = {}
    for n in map(int, arguments.scenes.split(",")):
        g = scene_on(n, "cuda")
        for size in arguments.sizes.split(","):
            width, height = map(int, size.split("x"))
            cameras = orbit_cameras(VIEWS, width, height)
            fwd, both, peak = measure(ours(), g, cameras, arguments.repeats)
            print(f"\n{n} Gaussians, {size}: ours {fwd:.3f} {both:.3f}  {peak:.0f} MiB", flush=True)
            found: dict[str, tuple[float, float]] = {}
            for name, draw in rivals.items():
                f, b, p = measure(draw, g, cameras, arguments.repeats)
                found[name] = f, b
                print(f"  {name:9s} {f:.3f} {b:.3f}  {p:.0f} MiB   ours / it {fwd / f:.2f} {both / b:.2f}")
            known = REFERENCE.get((n, size))
            if known:
                old, new = known
                yard = found.get("gsplat", old)
                scaled = tuple(new[i] * yard[i] / old[i] for i in (0, 1))
                found["ref"] = scaled[0], scaled[1]
                against = f"{fwd / scaled[0]:.2f} {both / scaled[1]:.2f}"
                print(f"  {'ref':9s} {scaled[0]:.3f} {scaled[1]:.3f}   ours / it {against}")
            for name, (f, b) in found.items():
                ratios.setdefault(name, []).append((fwd / f, both / b))
            if arguments.stages:
                print_stages(g, cameras, top)
            torch.cuda.empty_cache()
    print("\ngeometric means of ours over theirs, forward and forward + backward")
    for name, pairs in ratios.items():
        means = [math.exp(statistics.fmean(math.log(p[i]) for p in pairs)) for i in (0, 1)]
        worst = [max(p[i] for p in pairs) for i in (0, 1)]
        print(f"  {name:9s} {means[0]:.3f} {means[1]:.3f}   worst cell {worst[0]:.2f} {worst[1]:.2f}")


def one_view(r: StandardRasterizer, opt: RasterOptions, g: GaussianInputs, cameras: list[Camera], i: int) -> None:
    r.render(g, cameras[i % VIEWS], opt)


@torch.no_grad()
def inference(arguments: argparse.Namespace) -> bool:
    """Prints forward times and image agreement of the approximate rasterizers; whether all images agree."""
    kinds: dict[str, type[StandardRasterizer]] = {
        "exact": StandardRasterizer,
        "flash": FlashRasterizer,
        "tcgs": TensorCoreRasterizer,
    }
    drawn = {name: (kind(), RasterOptions()) for name, kind in kinds.items()}
    drawn["flash8"] = FlashRasterizer(), RasterOptions(dtype_out="uint8")
    print(f"{torch.cuda.get_device_name(0)}, torch {torch.__version__}; forward, milliseconds (of which blending)")
    good = True
    for n in map(int, arguments.scenes.split(",")):
        g = scene_on(n, "cuda")
        for size in arguments.sizes.split(","):
            width, height = map(int, size.split("x"))
            cameras = orbit_cameras(VIEWS, width, height)
            cells = []
            for name, (rasterizer, options) in drawn.items():
                draw = functools.partial(one_view, rasterizer, options, g, cameras)
                took = milliseconds(draw, arguments.repeats)
                counting = type(rasterizer)(count=name != "exact")  # the exact kernel is slower while it counts
                seconds = [counting.render(g, cam, options).stats.stage_seconds.get("blend") for cam in cameras]
                blend = [1e3 * s for s in seconds if s is not None]
                cells.append(f"{name} {took:.3f}" + (f" ({statistics.median(blend):.3f})" if blend else ""))
            bar = FASTEST_APPROXIMATE.get((n, size))
            print(f"\n{n} Gaussians, {size}: {', '.join(cells)}" + (f"; bar {bar:.2f}" if bar else ""), flush=True)
            for name in ("flash", "tcgs"):
                found = [agreement(g, cam, drawn[name][0]) for cam in cameras]
                psnr, mean, within, most = min(f[0] for f in found), *(max(f[i] for f in found) for i in (1, 2, 3))
                good &= psnr >= 50 and mean <= 5e-4 if name == "tcgs" else within <= 0.01 and most <= 4
                print(f"  {name}: PSNR {psnr:.1f} dB, mean |d| {mean:.1e}; 8 bit: {within:.1e} of the values more than "
                      f"1 level off, at most {most:.0f}")  # fmt: skip
    return good


def agreement(g: GaussianInputs, cam: Camera, rasterizer: StandardRasterizer) -> tuple[float, float, float, float]:
    """Against the exact image: PSNR, mean |d|; of 8-bit images the share more than a level off, most levels off."""
    exact = StandardRasterizer().render(g, cam, RasterOptions()).image
    seen = rasterizer.render(g, cam, RasterOptions()).image
    levels = rasterizer.render(g, cam, RasterOptions(dtype_out="uint8")).image.float()
    off = (levels - torch.round(255 * exact.clamp(0, 1))).abs()
    error = (seen - exact).double()
    psnr = -10 * math.log10(max(float(error.square().mean()), 1e-20))
    return psnr, float(error.abs().mean()), float((off > 1).float().mean()), float(off.max())


def print_stages(g: GaussianInputs, cameras: list[Camera], top: tuple[float, float, float]) -> None:
    took, counts = stages(g, cameras)
    least = limits(counts, *top)
    cells = [f"{s} {took[s]:.3f} ({least[s] / took[s]:.0%})" for s in (*FORWARD_STAGES, *BACKWARD_STAGES)]
    print("  stages (roofline): " + ", ".join(cells))
    whole = sum(least.values()) / sum(took.values())
    numbers = ", ".join(f"{k} {counts[k]:.0f}" for k in "VPEB")
    print(f"  in all {whole:.0%}; {numbers}; blended / evaluated {counts['B'] / counts['E']:.0%}")


def check(n: int, size: str) -> bool:
    """Prints how far image and gradients are from the CPU's kernels; whether that is within the tolerances."""
    width, height = map(int, size.split("x"))
    cam = orbit_cameras(VIEWS, width, height)[1]
    weight = torch.rand(3, height, width, generator=torch.Generator().manual_seed(0))
    results = []
    for device in ("cpu", "cuda"):
        g = scene_on(n, device)
        result = StandardRasterizer().render(g, cam, RasterOptions(grad2d=True))
        (result.image * weight.to(device)).sum().backward()
        assert result.grad2d is not None
        gradients = {name: x.grad.cpu() for name, x in g.tensors().items() if x.grad is not None}
        results.append(
            (result.image.detach().cpu(), result.radii.cpu(), {**gradients, "grad2d": result.grad2d.value.cpu()})
        )
    (image, radii, expected), (seen, seen_radii, found) = results
    error = (image - seen).abs()
    far, worst = float((error > 2e-5).float().mean()), float(error.max())
    off = (radii - seen_radii).abs()
    good = far <= 1e-4 and worst <= 0.012 and int(off.max()) <= 1 and float((off > 0).float().mean()) <= 1e-4
    print(f"{n} Gaussians, {size}: {far:.1e} of the values differ by more than 2e-5, at most by {worst:.1e}; "
          f"{int((off > 0).sum())} radii differ")  # fmt: skip
    for name, a in expected.items():
        b = found[name]
        relative = float((a.double() - b.double()).norm() / a.double().norm())
        good &= relative <= 1e-3
        print(f"  gradient of {name}: relative difference {relative:.1e}")
    return good


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", default="200000,1000000,3000000", help="Gaussians, separated by commas")
    parser.add_argument("--sizes", default="1237x822,1920x1080", help="images, WIDTHxHEIGHT, separated by commas")
    parser.add_argument("--repeats", type=int, default=40, help="timed runs (default: 40)")
    parser.add_argument("--stages", action="store_true", help="also each stage, with its fraction of the roofline")
    parser.add_argument("--inference", action="store_true", help="the approximate rasterizers, forward only, instead")
    parser.add_argument("--check", action="store_true", help="compare with the CPU's kernels instead")
    parser.add_argument("--sanitize", action="store_true", help="only draw a small scene, for compute-sanitizer")
    arguments = parser.parse_args()
    if not torch.cuda.is_available():
        raise SystemExit("no GPU: this benchmark needs one")
    started = time.monotonic()
    if arguments.sanitize:
        g, cam = scene_on(3000, "cuda"), orbit_cameras(VIEWS, 200, 150)[0]
        options = RasterOptions(grad2d=True, absgrad=True, alpha=True, depth=frozenset({"median", "inverse"}))
        for opt in (RasterOptions(), options):
            StandardRasterizer().render(g, cam, opt).image.sum().backward()
        with torch.no_grad():
            for rasterizer in (FlashRasterizer(), TensorCoreRasterizer()):
                rasterizer.render(g, cam, RasterOptions(alpha=True))
                rasterizer.render(g, cam, RasterOptions(dtype_out="uint8"))
        torch.cuda.synchronize()
    elif arguments.inference:
        if not inference(arguments):
            raise SystemExit("FAILED: the images do not agree")
    elif arguments.check:
        sizes = [(int(n), s) for n in arguments.scenes.split(",") for s in arguments.sizes.split(",")]
        if not all([check(n, s) for n, s in sizes]):  # noqa: C419 (all are printed)
            raise SystemExit("FAILED: outside the tolerances")
    else:
        table(arguments)
    print(f"({time.monotonic() - started:.0f} s)")


if __name__ == "__main__":
    main()
