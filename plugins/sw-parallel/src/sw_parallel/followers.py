"""Starts the other processes of a training: each makes the same steps on other views, and nothing else."""

from __future__ import annotations

import contextlib
import multiprocessing
import multiprocessing.connection
import os
import signal
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from multiprocessing.context import SpawnProcess
from multiprocessing.synchronize import Semaphore
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from splatwizard_core.api import (
    CapabilityError,
    PipelineParams,
    PluginManager,
    Scene,
    SplatModel,
    SplatwizardError,
    Stage,
    StageContext,
    TrainingState,
    View,
)
from splatwizard_core.tooling import NegotiatedRasterizer, Streams, Trainer, keep_pictures, load_plugins
from sw_parallel.ranks import Ranks, give_up, joined

MakeStage = Callable[[PluginManager, Ranks], Stage]
"""Makes the stage of a process; it is pickled, so a function of a module, or a `functools.partial` of one."""

FAREWELL_S = 60.0
"""Seconds that a process gets to end after the last step."""


@dataclass(frozen=True)
class Job:
    """All that a follower needs to go on from where the training is."""

    make_stage: MakeStage
    model: SplatModel
    scene: Scene
    ppl: PipelineParams
    device: str
    prefix: str  # of the random streams
    index: int
    name: str
    step: int
    state: Mapping[str, Any]
    threads: int

    @classmethod
    def of(cls, state: TrainingState, make_stage: MakeStage) -> Job:
        """Return the job of a training as it is between two steps."""
        return cls(
            make_stage, state.model, with_pictures(state.scene), state.ppl, state.device.type, state.streams.prefix,
            state.index, state.name, state.step, state.state_dict(), torch.get_num_threads(),
        )  # fmt: skip

    def begin(self, ranks: Ranks) -> Trainer:
        """Return the trainer of this process, after the step at which the training is."""
        torch.set_num_threads(self.threads)
        torch.use_deterministic_algorithms(self.ppl.deterministic)
        device = torch.device(self.device)
        if device.type == "cuda":
            torch.cuda.set_device(ranks.rank)
        plugins = load_plugins()
        stage, chosen = self.make_stage(plugins, ranks), self.ppl.raster
        rasterizer = NegotiatedRasterizer(
            plugins, device=device, prefer=chosen.prefer, forbid=chosen.forbid, suggested=stage.prefer,
            options=chosen.options,
        )  # fmt: skip
        streams = Streams(self.ppl.seed, self.prefix)
        model = self.model.to(device)
        model = stage.begin(StageContext(model, self.scene, self.ppl, rasterizer, streams, _no_other))
        state = TrainingState.begin(
            stage, model, self.scene, self.ppl, rasterizer, streams, index=self.index, name=self.name
        )
        state.load_state_dict(self.state, self.step)
        keep_pictures(self.scene.train, device)
        return Trainer(state)


def _no_other(name: str) -> SplatModel:
    raise CapabilityError(f"a training over several GPUs has no trained {name} scene to learn from", missing=[name])


@contextlib.contextmanager
def followed(state: TrainingState, make_stage: MakeStage, count: int) -> Iterator[Ranks]:
    """Train on in `count` processes in this block, of which this one is rank 0; the others end with it.

    state       between two steps: the others begin with a copy of it

    Raises CapabilityError if there are fewer GPUs, SplatwizardError if one of the others does not come up.
    """
    there = torch.cuda.device_count() if state.device.type == "cuda" else count
    if there < count:
        raise CapabilityError(
            f"gpus={count}: torch sees {there} CUDA device{'s' * (there != 1)} here", missing=["cuda"]
        )
    spawn = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory(prefix="splatwizard-") as folder:
        job, meeting, ready = Path(folder, "job.pt"), Path(folder, "meeting"), spawn.Semaphore(0)
        torch.save(Job.of(state, make_stage), job)
        others = [
            spawn.Process(target=follow, args=(Ranks(rank, count), job, meeting, ready), daemon=True)
            for rank in range(1, count)
        ]
        try:
            for process in others:
                process.start()
            wait_for(others, ready)
            with joined(Ranks(0, count), state.device, meeting) as ranks:
                try:
                    with _watched(others), _naming_killed(others):
                        yield ranks
                finally:
                    if not state.finished:
                        end(others)  # before the exchange ends, which they would take for a failure
        finally:
            for process in others:
                process.join(FAREWELL_S if state.finished else 0)
            end(others)


def end(others: Sequence[SpawnProcess]) -> None:
    """End these processes, if they have not yet."""
    for process in others:
        process.terminate()
    for process in others:
        process.join()


def follow(ranks: Ranks, job: Path, meeting: Path, ready: Semaphore) -> None:
    """Train to the end of the stage; what a process that was started for it does.

    ready   released when the training can go on
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a Ctrl-C is for the first process, which ends this one
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        trainer = torch.load(job, map_location="cpu", weights_only=False).begin(ranks)
        ready.release()
        with joined(ranks, trainer.device, meeting):
            trainer.run(trainer.state.iterations, lambda _: None)
    except SplatwizardError as error:
        print(f"error: process {ranks.rank} of {ranks.count} of the training: {error}", file=sys.stderr, flush=True)
        sys.exit(1)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)  # the main thread may wait in a call of a library


def wait_for(others: Sequence[SpawnProcess], ready: Semaphore) -> None:
    """Return when all are ready. Raises SplatwizardError if one ends before."""
    for _ in others:
        while not ready.acquire(timeout=0.1):
            if any(process.exitcode is not None for process in others):
                raise SplatwizardError("a process that should train along has ended before the first step")


@contextlib.contextmanager
def _watched(others: Sequence[SpawnProcess]) -> Iterator[None]:
    """Give up the exchange as soon as one of the processes fails: the GPU would wait for it for ever."""
    over = threading.Event()

    def watch() -> None:
        multiprocessing.connection.wait([process.sentinel for process in others])
        if not over.is_set() and any(process.exitcode for process in others):
            give_up()

    threading.Thread(target=watch, daemon=True).start()
    try:
        yield
    finally:
        over.set()


@contextlib.contextmanager
def _naming_killed(others: Sequence[SpawnProcess]) -> Iterator[None]:
    """Tell of a process that a signal ended, which had no words of its own."""
    try:
        yield
    except SplatwizardError as error:
        multiprocessing.connection.wait([process.sentinel for process in others], timeout=1)
        for process in others:
            if (process.exitcode or 0) < 0:
                raise SplatwizardError(
                    f"a process of this training was killed ({signal.Signals(-process.exitcode).name}; by the system, "
                    "if memory ran out): the same command goes on from the last checkpoint"
                ) from error
        raise


def with_pictures(scene: Scene) -> Scene:
    """Return a scene that another process can have: its training pictures in one tensor, neither test views nor masks.

    A stage that asks for masks, or for what else a scene brings, finds none.
    """
    pictured = [view for view in scene.train if view.load is not None]
    store = torch.cat([view.pixels.flatten() for view in pictured]) if pictured else torch.zeros(0, dtype=torch.uint8)
    views, start = [], 0
    for view in scene.train:
        load = None
        if view.load is not None:
            load = Picture(store, start, tuple(view.pixels.shape))
            start += view.pixels.numel()
        views.append(View(view.camera.to("cpu"), view.name, load))
    return replace(scene, train=views, test=[], ground_truth={}, warnings=[])


@dataclass(frozen=True)
class Picture:
    """Loads a picture from a tensor of many: bytes of `shape` [C,H,W] from `start` on."""

    store: Tensor
    start: int
    shape: tuple[int, ...]

    def __call__(self) -> np.ndarray[Any, np.dtype[np.uint8]]:
        """Return uint8 [H,W,C]."""
        flat = self.store[self.start : self.start + torch.Size(self.shape).numel()]
        return flat.view(self.shape).permute(1, 2, 0).numpy()
