"""Rendering speed: throughput, latency and peak memory, by the protocol.

All views are drawn once (at least ten frames) before any clock starts. CUDA: rounds over all views until 100 frames
or 2 s, with one synchronisation at both ends for the throughput, and again with one around every frame for the
latency. CPU: one round, which gives both. Each frame is consumed. Source: evaluation protocol, FPS.
"""

from __future__ import annotations

import itertools
import math
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

import torch
from torch import Tensor

from splatwizard_core.memory import MemoryMeter

WARMUP_FRAMES = 10
CUDA_FRAMES = 100
CUDA_SECONDS = 2.0

View = TypeVar("View")


@dataclass(frozen=True)
class SpeedReport:
    """What was measured.

    fps                 frames / total time, one synchronisation at both ends
    latency_ms_median, latency_ms_p95   of single frames, synchronised around each
    frames, rounds      behind `fps`; warm-up not counted
    views               different views
    warmup_frames       drawn before
    peak_bytes          memory over the measured rounds; `memory_kind` says which: "cuda" (allocator) or "rss" (growth)
    peak_reserved_bytes the allocator's pool; None on a CPU
    """

    fps: float
    latency_ms_median: float
    latency_ms_p95: float
    frames: int
    rounds: int
    views: int
    warmup_frames: int
    peak_bytes: int
    peak_reserved_bytes: int | None
    memory_kind: str


def measure_speed(
    render: Callable[[View], Tensor], views: Sequence[View], device: torch.device | str, *, max_rounds: int = 1000
) -> SpeedReport:
    """Draw `views` by the protocol and report how fast that was.

    render  one view -> the image, on `device`; gradients are off while it is called
    views   cameras, already on the device

    Raises ValueError without a view.
    """
    if not views:
        raise ValueError("measuring speed needs at least one view")
    device = torch.device(device)
    on_cuda = device.type == "cuda"
    sink = torch.zeros((), device=device)

    def draw(view: View) -> None:
        sink.add_(render(view).sum())

    def synchronize() -> None:
        if on_cuda:
            torch.cuda.synchronize(device)

    def timed_frames(chosen: Iterator[View]) -> list[float]:
        seconds = []
        for view in chosen:
            synchronize()
            began = time.perf_counter()
            draw(view)
            synchronize()
            seconds.append(time.perf_counter() - began)
        return seconds

    warmup = max(len(views), WARMUP_FRAMES)
    with torch.no_grad():
        began = time.perf_counter()
        for view in itertools.islice(itertools.cycle(views), warmup):
            draw(view)
        synchronize()
        round_seconds = (time.perf_counter() - began) * len(views) / warmup

        meter = MemoryMeter(device)
        meter.start()
        if on_cuda:
            enough = min(math.ceil(CUDA_FRAMES / len(views)), math.ceil(CUDA_SECONDS / max(round_seconds, 1e-6)))
            rounds = max(1, min(enough, max_rounds))
            began = time.perf_counter()
            for _ in range(rounds):
                for view in views:
                    draw(view)
            synchronize()
            total = time.perf_counter() - began
        else:
            rounds = 1
        began = time.perf_counter()
        latencies = timed_frames(itertools.islice(itertools.cycle(views), rounds * len(views)))
        if not on_cuda:
            total = time.perf_counter() - began
    frames = rounds * len(views)
    return SpeedReport(
        fps=frames / total,
        latency_ms_median=1e3 * statistics.median(latencies),
        latency_ms_p95=1e3 * percentile(latencies, 95),
        frames=frames,
        rounds=rounds,
        views=len(views),
        warmup_frames=warmup,
        peak_bytes=meter.peak_bytes(),
        peak_reserved_bytes=meter.peak_reserved_bytes(),
        memory_kind=meter.kind,
    )


def percentile(values: Sequence[float], percent: float) -> float:
    """Linear interpolation between the sorted values."""
    ordered = sorted(values)
    place = (len(ordered) - 1) * percent / 100
    low = math.floor(place)
    high = math.ceil(place)
    return ordered[low] + (ordered[high] - ordered[low]) * (place - low)
