"""Seconds to encode and to decode anchor files, by part, for each 100,000 anchors.

    python benchmarks/anchor_files.py                               # synthetic anchors, 1 and 2 threads
    python benchmarks/anchor_files.py --anchors 20000 --methods hac --threads 1
    python benchmarks/anchor_files.py out/room/hac/r4/scene.swz     # decode that file
    python benchmarks/anchor_files.py --device cuda --threads 1,2,16  # the model goes to the GPU at the end

Synthetic anchors lie on the walls of a room and have values that follow what the networks of the untrained model
predict: as many symbols as a trained scene has, at two to three bits. Each line is the best of `--repeats` runs; parts
do not overlap, `rest` is what no part names. The last line of a decoding is a digest of the model, which must be the
same on every machine, in every number of threads; the script stops with status 1 if it is not.
"""

from __future__ import annotations

import argparse
import collections
import importlib.util
import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from sw_anchors.coded_anchors import ENTROPY

from splatwizard_core.coding.container import ContainerReader, ContainerWriter
from splatwizard_core.method import create_method
from splatwizard_core.plugins import PluginManager, load_plugins
from splatwizard_core.runs.decode import decode_model
from splatwizard_core.scene.scene import PointCloud, Protocol, Scene

PARTS = {
    "sw_{}.codec:kept_geometry": "order of anchors",
    "sw_{}.codec:add_geometry": "positions, masks",
    "sw_{}.codec:read_geometry": "positions, masks",
    "sw_{}.codec:kept_voxels": "order of anchors",
    "sw_{}.codec:add_voxels": "positions, masks",
    "sw_{}.codec:read_voxels": "positions, masks",
    "sw_{}.codec:add_networks": "networks",
    "sw_{}.codec:read_networks": "networks",
    "sw_{}.codec:add_grid": "grid",
    "sw_{}.codec:read_grid": "grid",
    "sw_{}.codec:settled_copy": "copy of the model",
    "sw_{}.codec:_settled_context": "copy of the model",
    "sw_cat_3dgs.plane_coder:PlaneCoder.encode": "triplane",
    "sw_cat_3dgs.plane_coder:PlaneCoder.decode": "triplane",
    "sw_{}.codec:CatContext.places": "places",
    "sw_{}.rate_model:ExactPredictor.shift": "channel networks",
    "sw_anchors.attribute_sections:ExactNetwork.outputs": "context networks",
    "sw_anchors.attribute_sections:ExactNetwork.on_lattice": "context networks",
    "sw_codecs.entropy.conditional:ConditionalGaussian.encode": "symbols",
    "sw_codecs.entropy.conditional:ConditionalGaussian.decode_into": "symbols",
    "sw_codecs.entropy.conditional_mixture:ConditionalMixture.encode": "mixtures",
    "sw_codecs.entropy.conditional_mixture:ConditionalMixture.decode": "mixtures",
    "sw_anchors.attribute_sections:symbols_of": "rounding",
}
"""Module and attribute -> part; `{}` is the method."""


class Clock:
    """Seconds by part; what a part calls of another counts there alone."""

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self.seconds: dict[str, float] = collections.defaultdict(float)
        self._inside: list[str] = []
        self._since = 0.0

    def _turn(self) -> None:
        now = self._now()
        if self._inside:
            self.seconds[self._inside[-1]] += now - self._since
        self._since = now

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        self._turn()
        self._inside.append(name)
        try:
            yield
        finally:
            self._turn()
            self._inside.pop()

    def watched(self, call: Callable[..., Any], name: str) -> Callable[..., Any]:
        def watched(*args: Any, **kwargs: Any) -> Any:
            with self.part(name):
                return call(*args, **kwargs)

        return watched


@contextmanager
def watching(clock: Clock, method: str) -> Iterator[None]:
    """Let the clock see every part that the method has."""
    undo = []
    for place, name in PARTS.items():
        module, path = place.format(method.replace("-", "_")).split(":")
        if importlib.util.find_spec(module) is None:
            continue
        owner = importlib.import_module(module)
        *steps, leaf = path.split(".")
        for step in steps:
            owner = getattr(owner, step, None)
        if owner is None or leaf not in vars(owner):
            continue
        kept = vars(owner)[leaf]
        made = clock.watched(getattr(owner, leaf) if isinstance(kept, staticmethod) else kept, name)
        setattr(owner, leaf, staticmethod(made) if isinstance(kept, staticmethod) else made)
        undo.append((owner, leaf, kept))
    try:
        yield
    finally:
        for owner, leaf, kept in reversed(undo):
            setattr(owner, leaf, kept)


def room(count: int, generator: torch.Generator) -> torch.Tensor:
    """Points on the six walls of a box."""
    points = torch.rand(count, 3, generator=generator)
    axis = torch.arange(count) % 3
    points[torch.arange(count), axis] = (torch.arange(count) // 3 % 2).float()
    return (points - 0.5) * torch.tensor([8.0, 5.0, 3.0])


@torch.no_grad()
def synthetic(method: Any, count: int) -> Any:
    """A model of `count` anchors, half of whose offsets are masked."""
    generator = torch.Generator().manual_seed(0)
    points = room(count, generator)
    scene = Scene("synthetic", [], [], PointCloud(points, torch.full_like(points, 0.5)), Protocol("test"))
    model = method.create_model(scene, generator)
    n = model.num_rows
    model.features.copy_(torch.randn(model.features.shape, generator=generator) * 1.5)
    model.log_scales.copy_((torch.randn(model.log_scales.shape, generator=generator) * 0.2 - 3).clamp(max=0))
    model.offsets.copy_(torch.randn(model.offsets.shape, generator=generator) * 0.4)
    model.mask_logits.copy_(torch.where(torch.rand(n, model.num_offsets, generator=generator) < 0.5, 1.0, -9.0))
    model.phase = ENTROPY
    model.update_bounds()
    if hasattr(model, "start_from_statistics"):
        for grid in model.grid.grids:
            grid.table.copy_(torch.randn(grid.table.shape, generator=generator))
        model.start_from_statistics()
    else:
        context = model.context
        context.fit_frame(model.positions()[:20_000])
        resolution = max(1, round(math.sqrt(n / method.config.context.anchors_per_cell)))
        for i, plane in enumerate(context.triplane.initial(resolution, generator)):
            drawn = torch.randn(plane.shape, generator=generator) * 0.08
            setattr(context.triplane.planes, str(i), torch.nn.Parameter(drawn))
        context.start_at(model.raw(torch.arange(n)))
        context.rounded = True
    return model.eval()


def encode(method: Any, model: Any) -> bytes:
    writer = ContainerWriter(method.name, method.version)
    with torch.no_grad():
        method.encode(model, writer)
    return writer.to_bytes()


def measured(run: Callable[[], Any], method: str, args: argparse.Namespace) -> tuple[dict[str, float], float, Any]:
    """(seconds by part, seconds, result) of the fastest run."""
    best: tuple[dict[str, float], float, Any] = ({}, math.inf, None)
    for _ in range(args.repeats):
        clock = Clock(time.process_time if args.clock == "cpu" else time.perf_counter)
        with watching(clock, method), clock.part("rest"):
            result = run()
        total = sum(clock.seconds.values())
        if total < best[1]:
            best = (dict(clock.seconds), total, result)
    return best


def line(what: str, threads: int, parts: dict[str, float], total: float, anchors: int) -> str:
    each = 1e5 / anchors
    shown = ", ".join(f"{name} {parts[name] * each:.3f}" for name in sorted(parts, key=parts.__getitem__, reverse=True))
    return f"  {what} {threads} thread{'s' * (threads > 1)}: {total * each:.3f} s  ({shown})"


def decodings(data: bytes, name: str, plugins: PluginManager, args: argparse.Namespace) -> bool:
    """Print all decodings of a file; False if two differ."""
    reader, digests = ContainerReader(data, name), set()
    for threads in args.thread_counts:
        torch.set_num_threads(threads)

        def run() -> Any:
            model = decode_model(ContainerReader(data, name), plugins).to(args.device)
            if args.device == "cuda":
                torch.cuda.synchronize()
            return model

        parts, total, model = measured(run, reader.method, args)
        digests.add(model.digest())
        print(line("decode", threads, parts, total, max(model.num_rows, 1)), flush=True)
    print(f"  {len(data):,} bytes; digest of the model {', '.join(sorted(each[:16] for each in digests))}")
    return len(digests) == 1


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="*", type=Path, metavar="FILE.swz")
    parser.add_argument("--anchors", type=int, default=100_000)
    parser.add_argument("--methods", default="hac,cat-3dgs")
    parser.add_argument("--threads", default="1,2")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument(
        "--clock", choices=("wall", "cpu"), default="wall", help="cpu: of all threads, for a busy machine"
    )
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="where the decoded model goes")
    args = parser.parse_args()
    args.thread_counts = [int(each) for each in args.threads.split(",")]
    plugins, same = load_plugins(), True
    if args.device == "cuda":
        torch.zeros(1, device="cuda")
    for file in args.files:
        print(f"{file}")
        same &= decodings(file.read_bytes(), file.name, plugins, args)
    for name in [] if args.files else args.methods.split(","):
        method = create_method(plugins, name, {"voxel_size": 1e-4})
        model, written = synthetic(method, args.anchors), set()
        print(f"{name}, {model.num_rows:,} synthetic anchors, for each 100,000:")
        for threads in args.thread_counts:
            torch.set_num_threads(threads)
            parts, total, data = measured(lambda m=method, a=model: encode(m, a), name, args)
            written.add(data)
            print(line("encode", threads, parts, total, model.num_rows), flush=True)
        same &= len(written) == 1 and decodings(written.pop(), name, plugins, args)
    if not same:
        sys.exit("the results differ")


if __name__ == "__main__":
    main()
