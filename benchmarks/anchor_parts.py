"""Cost of the parts of a training step of HAC and CAT-3DGS on anchors of any number, without a scene or pictures.

    python benchmarks/anchor_parts.py --anchors 53000 118000 --device cuda --kernels 12

Anchors are drawn at random on a surface, with the networks of the preset; a share of them is visible. Each part runs
forward and backward, alone:

    decoding, full      attributes and Gaussians of the visible anchors, raw values
    decoding, rate      the same with noise of predicted steps, and the rate of the sample
    planes' rate        bits of all planes of CAT-3DGS under their spatial models
    optimizer           an update of everything that trains

A line says milliseconds (the least of several runs; on a GPU waited for), and what was moved: gigabytes in and out of
operators, as if none of it was kept in a cache, and how many operators there were. `--kernels` adds the longest kernels
(on a CPU operators).
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import torch
from sw_anchors.coded_anchors import ENTROPY
from torch import Tensor
from torch.profiler import ProfilerActivity, profile
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from splatwizard_core.plugins import load_plugins
from splatwizard_core.runs.config import resolve
from splatwizard_core.scene.camera import Camera
from splatwizard_core.scene.scene import PointCloud, Protocol, Scene, View
from splatwizard_core.streams import stream


class Moved(TorchDispatchMode):
    """Counts operators that compute, and the bytes of their tensors; views are free."""

    def __init__(self) -> None:
        super().__init__()
        self.bytes = self.operators = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        found = func(*args, **(kwargs or {}))
        inputs = [t for t in tree_leaves((args, kwargs)) if isinstance(t, Tensor)]
        outputs = [t for t in tree_leaves(found) if isinstance(t, Tensor)]
        there = {t.untyped_storage().data_ptr() for t in inputs}
        if func._schema.is_mutable or any(t.untyped_storage().data_ptr() not in there for t in outputs):
            self.operators += 1
            if "empty" not in func.__name__:
                self.bytes += sum(t.numel() * t.element_size() for t in (*inputs, *outputs))
        return found


def camera_before() -> Camera:
    """Three units before the anchors."""
    return Camera.look_at(
        torch.tensor([0.0, 0, -3]), torch.zeros(3), torch.tensor([0.0, 1, 0]), width=8, height=8, fov_x=1
    )


def made(name: str, count: int, preset: str, device: torch.device) -> tuple[Any, Any, Any]:
    """(stage, model, optimizer) of a method in its last phase, on `count` anchors."""
    plugins = load_plugins()
    cls = plugins.methods.load(name)
    # Only the time of the planes' set-up depends on the neighbours.
    sets = {"context.neighbors": 4} if name == "cat-3dgs" else {}
    method = cls(plugins, resolve(cls, preset, sets=sets, scene="demo").config)
    g = torch.Generator().manual_seed(0)
    points = torch.nn.functional.normalize(torch.randn(count, 3, generator=g), dim=1)
    points *= 1 + 0.1 * torch.sin(7 * points[:, :1])
    view = View(camera_before(), "0.png")
    scene = Scene("made", [view], [view], PointCloud(points, points.abs()), Protocol("made", background="black"))
    model = method.create_model(scene, stream(0, "init")).to(device)
    with torch.no_grad():
        for each, size in ((model.features, 1.0), (model.offsets, 0.5)):
            each.copy_(torch.randn(each.shape, generator=g) * size)
    (stage,) = method.stages()
    model = stage.begin(SimpleNamespace(model=model, scene=scene, generator=lambda label: stream(0, label)))
    model.update_bounds()
    optimizer = stage.create_optimizer(model, scene)
    if name == "cat-3dgs":
        stage.setup_triplane(model, optimizer)
        stage.round_planes(model)
    return stage, model, optimizer


def parts(name: str, stage: Any, model: Any, optimizer: Any, share: float) -> dict[str, Callable[[], None]]:
    drawn = torch.rand(model.num_rows, generator=torch.Generator().manual_seed(1)) < share
    rows = torch.nonzero(drawn).squeeze(1).to(model.device)
    camera = camera_before().to(model.device)

    def decoding(phase: str) -> None:
        model.phase = phase
        found = model.decode(camera, rows)
        total = sum(t.sum() for t in (found.means, found.opacities, found.scales, found.quats, found.colors))
        rate = found.extras.get("rate")
        if rate is not None:
            total = total + rate.bits + (0 if rate.own_bits is None else rate.own_bits)
        total.backward()

    found = {"decoding, full": lambda: decoding("full precision"), "decoding, rate": lambda: decoding(ENTROPY)}
    if name == "cat-3dgs":
        found["planes' rate"] = lambda: stage._plane_bits(model).backward()
    return {**found, "optimizer": lambda: optimizer.step(None)}


def measure(part: Callable[[], None], model: Any, repeat: int, kernels: int) -> None:
    cuda = model.device.type == "cuda"

    def run() -> float:
        if cuda:
            torch.cuda.synchronize()
        start = time.perf_counter()
        part()
        if cuda:
            torch.cuda.synchronize()
        return 1e3 * (time.perf_counter() - start)

    run()
    least = min(run() for _ in range(repeat))
    with Moved() as moved:
        part()
    print(f"{least:8.2f} ms {moved.bytes / 1e9:7.2f} GB {moved.operators:5} operators", flush=True)
    if kernels:
        with profile(activities=[ProfilerActivity.CPU] + [ProfilerActivity.CUDA] * cuda) as watched:
            run()
        times: dict[str, list[float]] = {}
        for event in watched.key_averages():
            # On a GPU its kernels, not the operators that launched them.
            if str(event.device_type).endswith("CUDA") == cuda:
                spent = event.self_device_time_total if cuda else event.self_cpu_time_total
                times[event.key] = [spent / 1e3, event.count]
        whole = sum(t for t, _ in times.values())
        print(f"{'':18}{whole:8.2f} ms in all of them")
        for key, (spent, count) in sorted(times.items(), key=lambda item: -item[1][0])[:kernels]:
            print(f"{'':18}{spent:8.3f} ms {count:5.0f} x {key[:110]}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--anchors", type=int, nargs="+", default=[53_000])
    parser.add_argument("--methods", default="hac,cat-3dgs")
    parser.add_argument("--preset", default="paper")
    parser.add_argument("--visible", type=float, default=0.6, help="share of the anchors")
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--kernels", type=int, default=0, help="how many of the longest to name")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cuda" if torch.cuda.is_available() else "cpu")
    args = parser.parse_args()
    device = torch.device(args.device)
    print(torch.cuda.get_device_name(0) if args.device == "cuda" else f"CPU, {torch.get_num_threads()} thread(s)")
    for name in args.methods.split(","):
        for count in args.anchors:
            stage, model, optimizer = made(name, count, args.preset, device)
            print(f"{name}, {model.num_rows:,} anchors, {args.visible:.0%} visible")
            for label, part in parts(name, stage, model, optimizer, args.visible).items():
                print(f"  {label:16}", end="")
                measure(part, model, args.repeat, args.kernels)


if __name__ == "__main__":
    main()
