"""Training speed of wisp by phase, as CUDA graphs, with kernels alone, in plain torch; operators of a step by part.

    python benchmarks/train_wisp.py --sizes 60000@800x800 --device cuda
    python benchmarks/train_wisp.py --sizes 60000@800x800 --device cuda --ways graphs --kernels 25
    python benchmarks/train_wisp.py --sizes 60000@800x800 --device cuda --ways graphs --tasks
    python benchmarks/train_wisp.py --sizes 8000@128x96 --steps 30 --device cpu --operators

Trains the synthetic scene of benchmarks/scene.py, drawn by itself with other colours, by the stage of wisp with its
plan shortened so that each phase has some steps: uniform noise with the bits in the loss, soft and hard rounding.
Nothing is removed, so that all steps have the same splats. Steps a second are those of the second half of a phase, the
first one warms up; the mean loss of these steps stands beside, which must be alike whatever the way. 3DGS, drawing as
many, comes last. --kernels lists those that take the GPU longest, those of graphs included. --operators counts what
torch is asked to do in a step, views and empty tensors left out: on a GPU each is at least one launch. Kernels of our
own are not among them, but on CUDA the profiler counts all launches. --tasks trains the whole plan in its place, scaled
to 180 steps, and tells what its tasks take (removal, levels, fits, measurements) and would in 18,000 steps.
"""

from __future__ import annotations

import argparse
import collections
import dataclasses
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest import mock

# A profiler that is taken down and set up again does not survive graphs (torch issue 75504).
os.environ.setdefault("DISABLE_CUPTI_LAZY_REINIT", "1")
os.environ.setdefault("TEARDOWN_CUPTI", "0")

import torch
from step_budget import scene_of
from step_budget import trainer_of as explicit_trainer
from step_parts import longest_kernels
from torch.profiler import ProfilerActivity, profile
from torch.utils._python_dispatch import TorchDispatchMode

from splatwizard_core.base.random_states import seeded
from splatwizard_core.plugins.manager import load_plugins
from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.scene.images import keep_pictures
from splatwizard_core.streams import Streams
from splatwizard_core.training.params import PipelineParams
from splatwizard_core.training.plan import Registration
from splatwizard_core.training.scheduler import build_schedulers
from splatwizard_core.training.stage import StageContext
from splatwizard_core.training.state import TrainingState
from splatwizard_core.training.trainer import Trainer
from sw_wisp.config import WispConfig
from sw_wisp.fast import replay
from sw_wisp.stage import WispStage

WAYS = ("graphs", "kernels", "plain")
"""Functions of `fast/`, on a GPU with CUDA graphs; without these; torch alone."""
PHASES = ("noise", "soft rounding", "hard rounding")
PARTS = {
    "model.gaussians": "splats as drawn",
    "rasterizer.render": "rasterizer",
    "stage.loss": "loss",
    "optimizer.step": "optimizer",
}
"""Attribute paths from the training's state -> part of a step; of nested ones the innermost counts."""


class Operators(TorchDispatchMode):
    """Counts operators by the part that runs."""

    def __init__(self) -> None:
        super().__init__()
        self.counts: collections.Counter[str] = collections.Counter()
        self.names: collections.Counter[str] = collections.Counter()
        self.part = "backward and the rest"

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        returned = func._schema.returns
        view = any(r.alias_info is not None and not r.alias_info.is_write for r in returned)
        if not view and not func.__name__.startswith(("empty", "_local_scalar", "detach", "new_empty")):
            self.counts[self.part] += 1
            self.names[func.__name__.split(".")[0]] += 1
        return func(*args, **(kwargs or {}))

    def watch(self, state: TrainingState) -> None:
        """Name the parts of a training's steps."""
        for path, name in PARTS.items():
            *owners, leaf = path.split(".")
            owner: Any = state
            for each in owners:
                owner = getattr(owner, each)
            object.__setattr__(owner, leaf, self._named(getattr(owner, leaf), name))

    def _named(self, call: Callable[..., Any], name: str) -> Callable[..., Any]:
        def named(*args: Any, **kwargs: Any) -> Any:
            before, self.part = self.part, name
            try:
                return call(*args, **kwargs)
            finally:
                self.part = before

        return named


def trainer_of(n: int, width: int, height: int, steps: int, device: str, kind: str) -> Trainer:
    """A training of wisp of three phases of `steps` steps each, behind the first."""
    bounds = {"noise": 1, "levels": [], "cells": 2, "place": 10**6, "soft": steps + 1, "hard": 2 * steps + 1}
    return begun(
        {
            "iterations": 18_000,
            "budget": {"cap": n, "cap_factor": 1.0, "worthless": 0.0},
            "rate_term": {"start": 1, "ramp": 1},
            "prune": {"rd": False},
            "context": {"kind": kind, "fit": 2, "rebuild": 10**6},
            "positions": {"rule": "mid"},
            "phases": {**bounds, "freeze": 10**6},
        }, n, width, height, device,
    )  # fmt: skip


def begun(values: dict[str, Any], n: int, width: int, height: int, device: str) -> Trainer:
    """A training of wisp with these values of its configuration."""
    config = WispConfig.model_validate(values)
    model, scene, _ = scene_of(n, width, height, device)
    keep_pictures(scene.train, device)
    stage, rasterizer, streams = WispStage(config), NegotiatedRasterizer(load_plugins(), device=device), Streams(0)
    ppl = PipelineParams(device=device)
    model = stage.begin(StageContext(model, scene, ppl, rasterizer, streams, lambda name: model))
    return Trainer(TrainingState.begin(stage, model, scene, ppl, rasterizer, streams))


@contextmanager
def made(way: str) -> Iterator[None]:
    """Train in one of WAYS."""
    with ExitStack() as stack:
        stack.enter_context(mock.patch.dict(os.environ, {"SW_FAST": "0" if way == "plain" else "1"}))
        if way == "kernels":
            stack.enter_context(mock.patch.object(replay, "fits", return_value=False))
        yield


def wait(device: str) -> float:
    """Seconds, when the device has done what it was asked to."""
    if device == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter()


def rate(trainer: Trainer, steps: int, device: str) -> tuple[float, float]:
    """Steps a second of the second half, and their mean loss."""
    trainer.run(trainer.state.step + steps // 2, lambda record: None)
    losses: list[torch.Tensor] = []
    since = wait(device)
    trainer.run(trainer.state.step + steps - steps // 2, lambda state: losses.append(state.total))
    return (steps - steps // 2) / (wait(device) - since), torch.stack(losses).mean().item()


def launches(trainer: Trainer, steps: int, most: int) -> tuple[float, float, list[str]]:
    """Launches a step, milliseconds of the GPU, and the longest kernels."""
    with profile(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA]) as found:
        trainer.run(trainer.state.step + steps, lambda record: None)
        torch.cuda.synchronize()
    kernels = [event for event in found.events() if str(event.device_type).endswith("CUDA")]
    busy = sum(event.time_range.elapsed_us() for event in kernels) / steps / 1e3
    return len(kernels) / steps, busy, longest_kernels(found, steps, most)


def tasks(n: int, width: int, height: int, args: argparse.Namespace) -> None:
    """Seconds of each task of the plan."""
    config = {"iterations": 180, "scale_schedule": True, "budget": {"cap": n, "cap_factor": 1.0, "worthless": 0.0}}
    trainer = begun(config, n, width, height, args.device)
    spent: dict[str, list[float]] = collections.defaultdict(list)
    for scheduler in (trainer.state.pre, trainer.state.post):
        scheduler.registrations[:] = [timed(entry, spent, args.device) for entry in scheduler.registrations]
    since = wait(args.device)
    trainer.run(180, lambda state: None)
    print(f"  {wait(args.device) - since:.1f} s for 180 steps, {trainer.state.num_rows:,} splats left")
    plans = build_schedulers(WispStage(WispConfig()), PipelineParams())
    for entry in (entry for plan in plans for entry in plan.registrations):
        times, of = len(entry.fires_in(0, 18_000)), spent[entry.name]
        if of:
            mean = sum(of) / len(of)
            print(f"  {entry.name:34} {1e3 * mean:9.2f} ms, {times:6,} times: {mean * times:7.2f} s")


def timed(entry: Registration, spent: dict[str, list[float]], device: str) -> Registration:
    """The same registration; what it takes goes into `spent`."""

    def binding(context: Any) -> Any:
        since = wait(device)
        try:
            return entry.binding(context)
        finally:
            spent[entry.name].append(wait(device) - since)

    return dataclasses.replace(entry, binding=binding)


def measure(n: int, width: int, height: int, args: argparse.Namespace) -> None:
    watched = min(10, args.steps // 4)
    print(f"{n:,} splats, {width}x{height}, {args.device}")
    for way in args.ways:
        if args.tasks:
            with seeded(0), made(way):
                tasks(n, width, height, args)
            continue
        with seeded(0), made(way):
            trainer = trainer_of(n, width, height, args.steps, args.device, args.context)
            for phase in PHASES:
                speed, loss = rate(trainer, args.steps - watched - 1, args.device)
                line = f"  {way:8} {phase:14} {speed:8.2f} steps/s, loss {loss:.6f}"
                longest: list[str] = []
                if args.device == "cuda":
                    count, busy, longest = launches(trainer, watched, args.kernels)
                    line += f"   {count:6.0f} launches, {busy:6.2f} ms of the GPU a step"
                else:
                    trainer.run(trainer.state.step + watched, lambda record: None)
                print("\n".join([line, *longest]), flush=True)
                mode = Operators()
                if args.operators:
                    mode.watch(trainer.state)
                    with mode:
                        trainer.run_step()
                    parts = ", ".join(f"{name} {count}" for name, count in mode.counts.most_common())
                    print(f"    {sum(mode.counts.values())} operators: {parts}")
                    print("    " + ", ".join(f"{name} {count}" for name, count in mode.names.most_common(12)))
                else:
                    trainer.run_step()
    model, scene, _ = scene_of(n, width, height, args.device)
    keep_pictures(scene.train, args.device)
    speed, _ = rate(explicit_trainer("dense", model, scene, args.device), args.steps, args.device)
    print(f"  3DGS {speed:8.2f} steps/s")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", default="60000@800x800", help="splats and picture, N@WIDTHxHEIGHT")
    parser.add_argument("--steps", type=int, default=200, help="steps of a phase (default: %(default)s)")
    parser.add_argument("--context", default="pyramid", choices=["pyramid", "none"])
    parser.add_argument(
        "--ways", default=",".join(WAYS), type=lambda text: text.split(","), help="(default: %(default)s)"
    )
    parser.add_argument("--kernels", type=int, default=0, help="how many of the longest kernels are listed")
    parser.add_argument("--tasks", action="store_true", help="time the tasks of the plan")
    parser.add_argument("--operators", action="store_true", help="count operators by part")
    parser.add_argument("--device", default="cuda", choices=["cuda", "cpu"])
    args = parser.parse_args()
    if args.device == "cuda" and not torch.cuda.is_available():
        sys.exit("torch sees no CUDA device here")
    for size in args.sizes.split(","):
        n, width, height = map(int, size.replace("@", "x").split("x"))
        measure(n, width, height, args)


if __name__ == "__main__":
    main()
