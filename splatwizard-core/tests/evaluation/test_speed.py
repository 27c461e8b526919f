"""The FPS protocol on fake renderers whose time is known."""

import time

import pytest
import torch

from splatwizard_core.evaluation.speed import WARMUP_FRAMES, measure_speed, percentile


class SleepyRenderer:
    """Sleeps, and keeps how long each call really took (a busy machine oversleeps)."""

    def __init__(self, seconds: float, first: float = 0.0) -> None:
        self.seconds, self.first = seconds, first
        self.took: list[float] = []
        self.seen: list[int] = []

    def __call__(self, view: int) -> torch.Tensor:
        began = time.perf_counter()
        time.sleep(self.first if len(self.took) < WARMUP_FRAMES else self.seconds)
        image = torch.full((3, 2, 2), float(view))
        self.seen.append(view)
        self.took.append(time.perf_counter() - began)
        return image


def test_frames_per_second_are_within_5_percent_and_warm_up_is_not_counted():
    renderer = SleepyRenderer(seconds=0.010, first=0.060)  # a slow first round must not show
    report = measure_speed(renderer, list(range(12)), "cpu")
    measured = renderer.took[report.warmup_frames :]
    assert report.warmup_frames == 12
    assert report.frames == len(measured) == 12
    assert report.fps == pytest.approx(len(measured) / sum(measured), rel=0.05)
    assert report.fps > 1 / 0.030
    assert report.latency_ms_median == pytest.approx(1e3 * sorted(measured)[6], rel=0.05)
    assert report.latency_ms_p95 >= report.latency_ms_median


def test_few_views_are_repeated_for_the_warm_up_only():
    renderer = SleepyRenderer(0.0)
    report = measure_speed(renderer, [1, 2, 3], "cpu")
    assert report.warmup_frames == WARMUP_FRAMES
    assert (report.rounds, report.frames, report.views) == (1, 3, 3)
    assert renderer.seen[-3:] == [1, 2, 3]


def test_gradients_are_off_while_frames_are_drawn():
    states = []

    def render(view: int) -> torch.Tensor:
        states.append(torch.is_grad_enabled())
        return torch.zeros(3, 1, 1)

    measure_speed(render, [0], "cpu")
    assert set(states) == {False}


def test_memory_on_a_cpu_is_flagged_and_sees_a_large_frame():
    def render(view: int) -> torch.Tensor:
        return torch.ones(3, 2048, 2048)  # 50 MB

    report = measure_speed(render, [0, 1], "cpu")
    assert report.memory_kind == "rss"
    assert report.peak_reserved_bytes is None
    assert report.peak_bytes >= 0


def test_no_view_is_refused():
    with pytest.raises(ValueError, match="at least one view"):
        measure_speed(lambda v: torch.zeros(3, 1, 1), [], "cpu")


def test_percentiles_are_interpolated():
    assert percentile([1.0], 95) == 1.0
    assert percentile([0.0, 10.0], 95) == pytest.approx(9.5)
    assert percentile([3.0, 1.0, 2.0], 50) == 2.0
