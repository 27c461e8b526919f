"""Time of the fused photometric loss and of Adam beside torch's ways of doing the same, in one run.

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

from splatwizard_core.training import losses
from splatwizard_core.training.adam import adam_step
from splatwizard_core.training.losses import photometric_loss
from splatwizard_core.training.native import TRAINING

# Floats a Gaussian: means, first and other spherical harmonics, opacity, scales, quaternion.
GROUPS = (3, 3, 45, 1, 3, 4)
SSIM_BYTES, ADAM_BYTES = 52, 28


def measure(variants: dict[str, Callable[[], object]], repeats: int) -> dict[str, list[float]]:
    """Milliseconds of each repeat, the variants taking turns; one round of warming up."""
    taken: dict[str, list[float]] = {name: [] for name in variants}
    for round_ in range(repeats + 1):
        for name, run in variants.items():
            start = time.perf_counter()
            run()
            if round_ > 0:
                taken[name].append(1e3 * (time.perf_counter() - start))
    return taken


def ssim_conv2d(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """SSIM as most 3DGS code writes it: five depthwise 11 x 11 convolutions."""
    offsets = torch.arange(-5.0, 6.0)
    line = torch.exp(-(offsets**2) / 4.5)
    line = line / line.sum()
    window = (line[:, None] * line).expand(3, 1, 11, 11)

    def blur(image: torch.Tensor) -> torch.Tensor:
        return F.conv2d(image[None], window, padding=5, groups=3)[0]

    mx, my = blur(x), blur(y)
    sx, sy, sxy = blur(x * x) - mx * mx, blur(y * y) - my * my, blur(x * y) - mx * my
    return (((2 * mx * my + 1e-4) * (2 * sxy + 9e-4)) / ((mx * mx + my * my + 1e-4) * (sx + sy + 9e-4))).mean()


def copy_variant() -> dict[str, Callable[[], object]]:
    source, copy = torch.rand(50_000_000), torch.empty(50_000_000)
    return {"copy_": lambda: copy.copy_(source)}


def loss_variants(height: int, width: int) -> dict[str, Callable[[], object]]:
    generator = torch.Generator().manual_seed(0)
    x = torch.rand(3, height, width, generator=generator)
    y = (x + 0.1 * torch.randn(3, height, width, generator=generator)).clamp(0, 1)

    def ours() -> None:
        photometric_loss(x.detach().requires_grad_(), y).total.backward()

    def torch_loss(similarity: Callable[[torch.Tensor, torch.Tensor], torch.Tensor]) -> None:
        image = x.detach().requires_grad_()
        (0.8 * (image - y).abs().mean() + 0.2 * (1 - similarity(image, y))).backward()

    return {
        "fused (ours)": ours,
        "torch, separable (our fallback)": lambda: torch_loss(lambda a, b: losses._ssim_torch(a, b, "same")),
        "torch, conv2d 11x11": lambda: torch_loss(ssim_conv2d),
    }


def adam_variants(gaussians: int, *, trained_sh: bool) -> dict[str, Callable[[], object]]:
    generator = torch.Generator().manual_seed(0)
    tensors = [torch.rand(gaussians, floats, generator=generator) for floats in GROUPS]
    grads = [torch.randn(t.shape, generator=generator) for t in tensors]
    if not trained_sh:
        grads[2].zero_()
    moments = [(torch.zeros_like(t), torch.zeros_like(t)) for t in tensors]
    steps = iter(range(1, 1_000_000))

    def ours() -> None:
        step = next(steps)
        for tensor, grad, (m, v) in zip(tensors, grads, moments, strict=True):
            adam_step(tensor, grad, m, v, lr=1e-4, beta1=0.9, beta2=0.999, eps=1e-15, step=step)

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
    arguments = parser.parse_args()
    height, width = map(int, arguments.size.split("x"))
    if not TRAINING.try_load():
        sys.exit("there are no compiled kernels to measure")
    parameters = arguments.gaussians * sum(GROUPS)
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


if __name__ == "__main__":
    main()
