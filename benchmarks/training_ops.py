"""Time of the fused photometric loss and of Adam beside torch's ways of doing the same, in one run.

    python benchmarks/training_ops.py --device cuda [--size 1080x1920] [--gaussians 1000000] [--repeats 40]
    python benchmarks/training_ops.py [--size 270x480] [--gaussians 245000] [--threads 1,2] [--repeats 15]

All variants of one op take turns, so that a busy machine slows all of them alike. Milliseconds are the minimum and
the median over the repeats. By the minimum: GB/s count the bytes that the op must move (52 a pixel and channel for
SSIM forward and backward, 28 a parameter for Adam), whatever the variant moves in fact; "x" is the time over ours.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable

import torch
from torch.nn import functional as F  # noqa: N812

from splatwizard_core.training.losses import photometric_loss
from splatwizard_native import AdamUpdate, adam_steps
from splatwizard_native.fused import photometric as fused
from splatwizard_native.fused.native import TRAINING

# Floats a Gaussian: means, first and other spherical harmonics, opacity, scales, quaternion.
GROUPS = (3, 3, 45, 1, 3, 4)
SSIM_BYTES, ADAM_BYTES = 52, 28


def measure(variants: dict[str, Callable[[], object]], repeats: int, *, on_gpu: bool = False) -> dict[str, list[float]]:
    """Milliseconds of each repeat, the variants taking turns; one round of warming up, on a GPU five."""
    taken: dict[str, list[float]] = {name: [] for name in variants}
    warm_up = 5 if on_gpu else 1
    for round_ in range(repeats + warm_up):
        for name, run in variants.items():
            milliseconds = timed_on_gpu(run) if on_gpu else timed(run)
            if round_ >= warm_up:
                taken[name].append(milliseconds)
    return taken


def timed(run: Callable[[], object]) -> float:
    start = time.perf_counter()
    run()
    return 1e3 * (time.perf_counter() - start)


def timed_on_gpu(run: Callable[[], object]) -> float:
    """The device is kept busy before, so that the host's part of launching does not show."""
    marks = [torch.cuda.Event(enable_timing=True) for _ in range(2)]
    torch.cuda._sleep(1_000_000)
    marks[0].record()
    run()
    marks[1].record()
    torch.cuda.synchronize()
    return marks[0].elapsed_time(marks[1])


def ssim_conv2d(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """SSIM as most 3DGS code writes it: five depthwise 11 x 11 convolutions."""
    offsets = torch.arange(-5.0, 6.0, device=x.device)
    line = torch.exp(-(offsets**2) / 4.5)
    line = line / line.sum()
    window = (line[:, None] * line).expand(3, 1, 11, 11)

    def blur(image: torch.Tensor) -> torch.Tensor:
        return F.conv2d(image[None], window, padding=5, groups=3)[0]

    mx, my = blur(x), blur(y)
    sx, sy, sxy = blur(x * x) - mx * mx, blur(y * y) - my * my, blur(x * y) - mx * my
    return (((2 * mx * my + 1e-4) * (2 * sxy + 9e-4)) / ((mx * mx + my * my + 1e-4) * (sx + sy + 9e-4))).mean()


def copy_variant(device: str = "cpu") -> dict[str, Callable[[], object]]:
    source, copy = torch.rand(50_000_000, device=device), torch.empty(50_000_000, device=device)
    return {"copy_": lambda: copy.copy_(source)}


def loss_variants(height: int, width: int, device: str = "cpu") -> dict[str, Callable[[], object]]:
    generator = torch.Generator().manual_seed(0)
    x = torch.rand(3, height, width, generator=generator)
    y = (x + 0.1 * torch.randn(3, height, width, generator=generator)).clamp(0, 1).to(device)
    x = x.to(device)

    def ours() -> None:
        photometric_loss(x.detach().requires_grad_(), y).total.backward()

    def torch_loss(similarity: Callable[[torch.Tensor, torch.Tensor], torch.Tensor]) -> None:
        image = x.detach().requires_grad_()
        (0.8 * (image - y).abs().mean() + 0.2 * (1 - similarity(image, y))).backward()

    return {
        "fused (ours)": ours,
        "torch, separable (our fallback)": lambda: torch_loss(lambda a, b: fused.ssim_map(a, b).mean()),
        "torch, conv2d 11x11": lambda: torch_loss(ssim_conv2d),
    }


def adam_variants(gaussians: int, *, trained_sh: bool, device: str = "cpu") -> dict[str, Callable[[], object]]:
    generator = torch.Generator().manual_seed(0)
    tensors = [torch.rand(gaussians, floats, generator=generator).to(device) for floats in GROUPS]
    grads = [torch.randn(t.shape, generator=generator).to(device) for t in tensors]
    if not trained_sh:
        grads[2].zero_()
    moments = [(torch.zeros_like(t), torch.zeros_like(t)) for t in tensors]
    steps = iter(range(1, 1_000_000))

    def ours() -> None:
        step = next(steps)
        adam_steps(
            [
                AdamUpdate(tensor, grad, m, v, lr=1e-4, beta1=0.9, beta2=0.999, eps=1e-15, step=step)
                for tensor, grad, (m, v) in zip(tensors, grads, moments, strict=True)
            ]
        )

    def torchs(**options: bool) -> Callable[[], object]:
        parameters = [torch.nn.Parameter(t.clone()) for t in tensors]
        for parameter, grad in zip(parameters, grads, strict=True):
            parameter.grad = grad
        return torch.optim.Adam(parameters, lr=1e-4, eps=1e-15, **options).step

    return {
        "compiled (ours)": ours,
        "torch.optim.Adam": torchs(foreach=False),
        "torch.optim.Adam, foreach": torchs(foreach=True),
        "torch.optim.Adam, fused": torchs(fused=True),
    }


def show(title: str, taken: dict[str, list[float]], moved: float) -> None:
    base = min(next(iter(taken.values())))
    print(f"  {title}")
    for name, times in taken.items():
        best, middle = min(times), statistics.median(times)
        rate = moved / best / 1e6
        print(f"    {name:34s} {best:9.2f} {middle:9.2f} ms {rate:8.1f} GB/s {best / base:7.1f} x")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", default="270x480", help="height x width")
    parser.add_argument("--gaussians", type=int, default=245_000)
    parser.add_argument("--threads", default="1,2")
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    arguments = parser.parse_args()
    height, width = map(int, arguments.size.split("x"))
    if not TRAINING.try_load():
        sys.exit("there are no compiled kernels to measure")
    parameters = arguments.gaussians * sum(GROUPS)
    if arguments.device == "cuda":
        measure_gpu(arguments, height, width)
        return
    for threads in map(int, arguments.threads.split(",")):
        torch.set_num_threads(threads)
        print(f"\n{threads} thread(s), torch {torch.__version__}: minimum and median")
        show("copy of 200 MB, for scale", measure(copy_variant(), 5), 2 * 4 * 50e6)
        show(
            f"0.8 L1 + 0.2 (1 - SSIM), forward and backward, 3 x {height} x {width}",
            measure(loss_variants(height, width), arguments.repeats),
            SSIM_BYTES * 3 * height * width,
        )
        for trained_sh, what in ((True, "all trained"), (False, "SH bands 1-3 not yet trained")):
            show(
                f"Adam, {arguments.gaussians} Gaussians of {sum(GROUPS)} floats, {what}",
                measure(adam_variants(arguments.gaussians, trained_sh=trained_sh), arguments.repeats),
                ADAM_BYTES * parameters,
            )


def measure_gpu(arguments: argparse.Namespace, height: int, width: int) -> None:
    if not TRAINING.has_cuda():
        sys.exit(f"there are no CUDA kernels to measure: {TRAINING.available(cuda=True)}")
    repeats, n = arguments.repeats, arguments.gaussians
    print(f"{torch.cuda.get_device_name(0)}, torch {torch.__version__}: minimum and median")
    show("copy of 200 MB, for scale", measure(copy_variant("cuda"), repeats, on_gpu=True), 2 * 4 * 50e6)
    show(
        f"0.8 L1 + 0.2 (1 - SSIM), forward and backward, 3 x {height} x {width}",
        measure(loss_variants(height, width, "cuda"), repeats, on_gpu=True),
        SSIM_BYTES * 3 * height * width,
    )
    for trained_sh, what in ((True, "all trained"), (False, "SH bands 1-3 not yet trained")):
        show(
            f"Adam, {n} Gaussians of {sum(GROUPS)} floats, {what}",
            measure(adam_variants(n, trained_sh=trained_sh, device="cuda"), repeats, on_gpu=True),
            ADAM_BYTES * n * sum(GROUPS),
        )


if __name__ == "__main__":
    main()
