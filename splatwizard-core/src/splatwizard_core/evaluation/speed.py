"""Rendering speed: throughput, latency and peak memory, by the protocol.

All views are drawn once (at least ten frames) before any clock starts. CUDA: rounds over all views until 100 frames
or 2 s, with one synchronisation at both ends for the throughput, and again with one around every frame for the
latency. CPU: one round, which gives both. Each frame is consumed. The whole may be repeated, for the spread.
Source: evaluation protocol, FPS.
"""

from __future__ import annotations

import itertools
import math
import statistics
from collections.abc import Callable, Sequence
from typing import Annotated, TypeVar

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from splatwizard_core.base.block import Block, MemoryKind, WhyNull
from splatwizard_core.base.memory import MemoryMeter, synchronize
from splatwizard_core.base.progress import track
from splatwizard_native import work_time

WARMUP_FRAMES = 10
CUDA_FRAMES = 100
CUDA_SECONDS = 2.0

View = TypeVar("View")


class SpreadBlock(Block):
    """Spread of repeated measurements of one thing."""

    n: int = Field(ge=2, description="measurements")
    mean: float
    std: float = Field(description="of the sample (n - 1)")
    min: float
    max: float


class SpeedBlock(Block):
    """Rendering, by the FPS protocol, of the model decoded from the file."""

    fps: float | None = Field(None, description="frames per second")
    latency_ms_median: float | None = None
    latency_ms_p95: float | None = None
    jit_s: float | None = Field(None, description="loading or compiling native modules; in no other figure")
    prepare_s: float | None = Field(None, description="view-independent caches, built once, not in `fps`")
    load_s: float | None = Field(None, description="from opening the file to the first frame; without `jit_s`")
    frames: int | None = Field(None, description="measured, over all repeats")
    rounds: int | None = Field(None, description="over all views, in each repeat")
    repeats: int | None = None
    views: int | None = None
    warmup_frames: int | None = Field(None, description="drawn before the clock starts")
    spread: Annotated[dict[str, SpreadBlock] | None, WhyNull("measured once (--repeats N)")] = Field(
        None, description="of fps and the latencies over the repeats"
    )
    image_size: tuple[int, int] | None = Field(None, description="width, height of the first view drawn")
    drawn_by: dict[str, str] = Field({}, description="rasterizers that drew the frames -> whose kernels those are")
    default_fps: dict[str, float] = Field(
        {}, description="`fps` by the kernels that draw where a file names none; empty: those drew the frames"
    )


class SpeedReport(SpeedBlock):
    """Result of `measure_speed`: fields of the record's block that are known at this point, and

    first_frame_s       the first frame of all, a part of the warm-up
    peak_bytes          memory over the measured rounds; `memory_kind` says which: "cuda" (allocator) or "rss" (growth)
    peak_reserved_bytes the allocator's pool; None on a CPU
    """

    fps: float
    first_frame_s: float
    peak_bytes: int
    peak_reserved_bytes: int | None
    memory_kind: MemoryKind


def measure_speed(
    render: Callable[[View], Tensor], views: Sequence[View], device: torch.device | str, *, repeats: int = 1
) -> SpeedReport:
    """Draw `views` by the protocol and report how fast that was.

    render      one view -> the image, on `device`; gradients are off while it is called
    views       cameras, already on the device
    repeats     measure this often, after one warm-up

    Raises ValueError without a view or a repeat.
    """
    if not views or repeats < 1:
        raise ValueError("measuring speed needs at least one view and one repeat")
    device = torch.device(device)
    on_cuda = device.type == "cuda"
    sink: Tensor | None = None

    def seconds_of(frames: Sequence[View]) -> float:
        """Draw frames, waiting for the device at both ends alone; each is consumed, so that none can be left undone."""
        nonlocal sink
        synchronize(device)
        began = work_time()
        for view in frames:
            total = render(view).sum()
            sink = total if sink is None else sink + total
        synchronize(device)
        return work_time() - began

    warmup = max(len(views), WARMUP_FRAMES)
    rounds = 1
    totals: list[float] = []
    latencies: list[list[float]] = []
    meter = MemoryMeter(device)
    with torch.no_grad(), track("measure speed", total=1 + repeats) as bar:
        first_frame_s = seconds_of(views[:1])
        seconds_of(list(itertools.islice(itertools.cycle(views), 1, warmup)))
        bar.advance()
        if on_cuda:
            # The first frame may load kernels, so the length of a round is taken from one that is warm.
            round_seconds = seconds_of(views)
            rounds = min(math.ceil(CUDA_FRAMES / len(views)), math.ceil(CUDA_SECONDS / max(round_seconds, 1e-6)))
            warmup += len(views)
        measured = list(views) * rounds
        meter.start()
        for _ in range(repeats):
            if on_cuda:
                totals.append(seconds_of(measured))
            latencies.append([seconds_of([view]) for view in measured])
            if not on_cuda:
                totals.append(sum(latencies[-1]))
            bar.advance()
    pooled = [seconds for each in latencies for seconds in each]
    return SpeedReport(
        fps=repeats * len(measured) / sum(totals),
        latency_ms_median=1e3 * statistics.median(pooled),
        latency_ms_p95=1e3 * float(np.percentile(pooled, 95)),
        frames=repeats * len(measured),
        rounds=rounds,
        repeats=repeats,
        views=len(views),
        warmup_frames=warmup,
        first_frame_s=first_frame_s,
        spread=None if repeats == 1 else {
            "fps": spread([len(measured) / seconds for seconds in totals]),
            "latency_ms_median": spread([1e3 * statistics.median(each) for each in latencies]),
            "latency_ms_p95": spread([1e3 * float(np.percentile(each, 95)) for each in latencies]),
        },
        peak_bytes=meter.peak_bytes(),
        peak_reserved_bytes=meter.peak_reserved_bytes(),
        memory_kind=meter.kind,
    )  # fmt: skip


def spread(values: Sequence[float]) -> SpreadBlock:
    """Mean, sample standard deviation, least and largest of at least two values."""
    mean, std = statistics.fmean(values), statistics.stdev(values)
    return SpreadBlock(n=len(values), mean=mean, std=std, min=min(values), max=max(values))
