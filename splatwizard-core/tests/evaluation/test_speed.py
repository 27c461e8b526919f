"""The FPS protocol on fake renderers whose time is known."""

import time

import pytest
import torch
from fresh_memory import fresh_memory

from splatwizard_core.evaluation import speed
from splatwizard_core.evaluation.speed import WARMUP_FRAMES, measure_speed, spread


class ClockedRenderer:
    """Takes times of its own making, on a clock that nothing else moves: no test waits, every value is exact.

    seconds     of a frame after the warm-up, and up to 40 % more; `first`: of each frame of the warm-up
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, seconds: float, first: float = 0.0) -> None:
        self.seconds, self.first, self.now = seconds, first, 0.0
        self.took: list[float] = []
        self.seen: list[int] = []
        monkeypatch.setattr(speed, "work_time", lambda: self.now)

    def __call__(self, view: int) -> torch.Tensor:
        drawn = len(self.took)
        self.took.append(self.first if drawn < WARMUP_FRAMES else self.seconds * (1 + 0.1 * (drawn % 5)))
        self.now += self.took[-1]
        self.seen.append(view)
        return torch.full((3, 2, 2), float(view))


def test_frames_per_second_are_those_of_the_measured_frames_and_warm_up_is_not_counted(monkeypatch):
    renderer = ClockedRenderer(monkeypatch, seconds=0.010, first=0.060)  # a slow first round must not show
    report = measure_speed(renderer, list(range(13)), "cpu")
    measured = renderer.took[report.warmup_frames :]
    assert report.warmup_frames == 13
    assert report.frames == len(measured) == 13
    assert report.fps == pytest.approx(len(measured) / sum(measured))
    assert report.latency_ms_median == pytest.approx(1e3 * sorted(measured)[6])
    assert report.latency_ms_p95 == pytest.approx(14.0)


class SleepingRenderer:
    """Sleeps 20 ms a frame, and notes how long each took on a clock of its own."""

    def __init__(self) -> None:
        self.took: list[float] = []

    def __call__(self, view: int) -> torch.Tensor:
        start = time.monotonic()
        time.sleep(0.020)
        self.took.append(time.monotonic() - start)
        return torch.zeros(3, 1, 1)


@pytest.mark.slow
def test_the_clock_goes_on_while_a_frame_waits():
    """As it does for a GPU; a clock of the process's own work would tell thousands of frames per second."""
    report = measure_speed(SleepingRenderer(), [0], "cpu")
    assert report.latency_ms_median >= 20
    assert report.fps <= 50


@pytest.mark.slow
def test_the_clock_is_right_within_5_percent():
    renderer = SleepingRenderer()
    report = measure_speed(renderer, list(range(20)), "cpu")
    measured = renderer.took[report.warmup_frames :]
    assert report.fps == pytest.approx(len(measured) / sum(measured), rel=0.05)
    assert report.latency_ms_median == pytest.approx(1e3 * sorted(measured)[len(measured) // 2], rel=0.05)


def test_few_views_are_repeated_for_the_warm_up_only(monkeypatch):
    renderer = ClockedRenderer(monkeypatch, seconds=0.001)
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
        return torch.from_numpy(fresh_memory(3 * 2048 * 2048 * 4)).view(torch.float32)  # 50 MB

    report = measure_speed(render, [0, 1], "cpu")
    assert report.memory_kind == "rss"
    assert report.peak_reserved_bytes is None
    assert report.peak_bytes >= 48e6  # 50.3, less what happens to be given back meanwhile


def test_no_view_is_refused():
    with pytest.raises(ValueError, match="at least one view"):
        measure_speed(lambda v: torch.zeros(3, 1, 1), [], "cpu")
    with pytest.raises(ValueError, match="one repeat"):
        measure_speed(lambda v: torch.zeros(3, 1, 1), [0], "cpu", repeats=0)


def test_repeats_are_measured_after_one_warm_up_and_give_the_spread(monkeypatch):
    renderer = ClockedRenderer(monkeypatch, seconds=0.004)
    report = measure_speed(renderer, list(range(11)), "cpu", repeats=3)
    measured = [renderer.took[11 * k : 11 * k + 11] for k in (1, 2, 3)]
    assert len(renderer.took) == 44
    assert (report.repeats, report.rounds, report.frames, report.warmup_frames) == (3, 1, 33, 11)
    assert report.fps == pytest.approx(33 / sum(map(sum, measured)))
    each = [11 / sum(run) for run in measured]
    assert len(set(each)) == 3
    fps = report.spread["fps"]
    assert (fps.n, fps.mean) == (3, pytest.approx(sum(each) / 3))
    assert (fps.min, fps.max) == (pytest.approx(min(each)), pytest.approx(max(each)))
    assert fps.min <= report.fps <= fps.max
    assert set(report.spread) == {"fps", "latency_ms_median", "latency_ms_p95"}


def test_a_single_measurement_has_no_spread():
    assert measure_speed(lambda v: torch.zeros(3, 1, 1), [0], "cpu").spread is None


def test_the_spread_is_that_of_a_sample():
    found = spread([1.0, 2.0, 4.0])
    assert (found.n, found.min, found.max, found.mean) == (3, 1.0, 4.0, pytest.approx(7 / 3))
    assert found.std == pytest.approx((((4 / 3) ** 2 + (1 / 3) ** 2 + (5 / 3) ** 2) / 2) ** 0.5)


def test_the_first_frame_is_timed_apart(monkeypatch):
    renderer = ClockedRenderer(monkeypatch, seconds=0.005, first=0.020)
    assert measure_speed(renderer, [0], "cpu").first_frame_s == pytest.approx(0.020)


class FakeGpu:
    """A device that works behind the host's back, on a clock of its own: no test waits, every value is exact.

    launch, work    seconds of the host and of the device for one frame
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, launch: float, work: float, first: float = 0.0) -> None:
        self.launch, self.work, self.first = launch, work, first
        self.now = self.busy_until = 0.0
        self.frames = self.synchronized = self.resets = 0
        self.frames_at_reset: list[int] = []
        monkeypatch.setattr(speed, "work_time", lambda: self.now)
        monkeypatch.setattr(torch.cuda, "synchronize", self.synchronize)
        monkeypatch.setattr(torch.cuda, "reset_peak_memory_stats", self.reset)
        monkeypatch.setattr(torch.cuda, "max_memory_allocated", lambda device: 1000 + self.frames)
        monkeypatch.setattr(torch.cuda, "max_memory_reserved", lambda device: 5000)

    def synchronize(self, device: torch.device) -> None:
        assert device.type == "cuda"
        self.now = max(self.now, self.busy_until)
        self.synchronized += 1

    def reset(self, device: torch.device) -> None:
        self.frames_at_reset.append(self.frames)

    def __call__(self, view: int) -> torch.Tensor:
        self.now += self.launch
        self.busy_until = max(self.busy_until, self.now) + self.work + (self.first if self.frames == 0 else 0.0)
        self.frames += 1
        return torch.ones(3, 2, 2)


def test_on_cuda_throughput_waits_at_both_ends_and_latency_around_each_frame(monkeypatch):
    gpu = FakeGpu(monkeypatch, launch=0.001, work=0.004, first=3.0)
    report = measure_speed(gpu, list(range(20)), "cuda")
    # Launches hide behind the device's work, all but the first.
    assert report.rounds == 5  # 100 frames are enough
    assert report.frames == 100
    assert report.fps == pytest.approx(100 / (0.001 + 100 * 0.004))
    assert report.latency_ms_median == pytest.approx(5.0)
    assert report.latency_ms_p95 == pytest.approx(5.0)
    assert report.first_frame_s == pytest.approx(3.005)
    assert report.warmup_frames == 40  # all views once, and a round that tells how long one takes
    assert gpu.frames == 40 + 100 + 100


def test_on_cuda_two_seconds_are_enough_for_slow_frames(monkeypatch):
    gpu = FakeGpu(monkeypatch, launch=0.0, work=0.25)
    report = measure_speed(gpu, [0, 1, 2, 3], "cuda")
    assert (report.rounds, report.frames) == (2, 8)  # 2 rounds of 1 s
    assert report.fps == pytest.approx(4.0)


def test_on_cuda_peak_memory_is_that_of_the_measured_rounds(monkeypatch):
    gpu = FakeGpu(monkeypatch, launch=0.0, work=0.01)
    report = measure_speed(gpu, list(range(10)), "cuda", repeats=2)
    assert gpu.frames_at_reset == [report.warmup_frames]  # once, after the warm-up, outside what is timed
    assert report.frames == 200
    assert (report.memory_kind, report.peak_bytes, report.peak_reserved_bytes) == ("cuda", 1000 + gpu.frames, 5000)
    assert report.spread["fps"].std == pytest.approx(0.0, abs=1e-9)
