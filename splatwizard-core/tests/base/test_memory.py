"""Peak memory: what counts, and what is left out."""

import numpy as np
import pytest
import torch
from fresh_memory import fresh_memory

from splatwizard_core.base import memory
from splatwizard_core.base.memory import MemoryMeter, reset_peak_rss

MEGABYTE = 1 << 20

needs_reset = pytest.mark.skipif(not reset_peak_rss(), reason="this system cannot reset a resident set's peak")


def touch(megabytes: int) -> np.ndarray:
    """Memory that is really there."""
    return fresh_memory(megabytes * MEGABYTE)


@needs_reset
def test_the_peak_is_above_what_was_there_at_the_start_and_stays_when_memory_is_given_back():
    held = touch(30)
    meter = MemoryMeter("cpu")
    meter.start()
    block = touch(60)
    assert meter.current_bytes() >= 55 * MEGABYTE
    del block
    assert 55 * MEGABYTE <= meter.peak_bytes() < 85 * MEGABYTE
    assert held[-1] == 1


@needs_reset
def test_what_is_excluded_does_not_count_and_what_was_there_before_does():
    meter = MemoryMeter("cpu")
    meter.start()
    del_me = touch(40)
    del del_me
    with meter.excluded():
        large = touch(150)
        del large
    small = touch(10)
    del small
    assert 35 * MEGABYTE <= meter.peak_bytes() < 80 * MEGABYTE


@needs_reset
def test_what_comes_after_an_excluded_part_counts():
    meter = MemoryMeter("cpu")
    meter.start()
    with meter.excluded():
        pass
    block = touch(60)
    del block
    assert meter.peak_bytes() >= 55 * MEGABYTE


class FakeAllocator:
    """torch.cuda's statistics, set by hand."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = self.peak = 0
        monkeypatch.setattr(torch.cuda, "synchronize", lambda device: None)
        monkeypatch.setattr(torch.cuda, "reset_peak_memory_stats", lambda device: setattr(self, "peak", self.now))
        monkeypatch.setattr(torch.cuda, "max_memory_allocated", lambda device: self.peak)
        monkeypatch.setattr(torch.cuda, "max_memory_reserved", lambda device: 10 * self.peak)
        monkeypatch.setattr(torch.cuda, "memory_allocated", lambda device: self.now)

    def allocate(self, number: int) -> None:
        self.now += number
        self.peak = max(self.peak, self.now)


def test_on_cuda_the_allocators_peak_counts_absolutely_and_parts_can_be_excluded(monkeypatch: pytest.MonkeyPatch):
    allocator = FakeAllocator(monkeypatch)
    allocator.allocate(100)
    meter = MemoryMeter("cuda")
    meter.start()
    allocator.allocate(50)
    allocator.allocate(-50)
    with meter.excluded():
        allocator.allocate(900)
        allocator.allocate(-900)
    allocator.allocate(20)
    assert (meter.kind, meter.peak_bytes(), meter.peak_reserved_bytes()) == ("cuda", 150, 1500)
    assert meter.current_bytes() == 120
    meter.start()
    assert meter.peak_bytes() == 120


def test_where_the_peak_cannot_be_reset_everything_counts(monkeypatch: pytest.MonkeyPatch):
    peak = [10 * MEGABYTE]
    monkeypatch.setattr(memory, "reset_peak_rss", lambda: False)
    monkeypatch.setattr(memory, "rss_bytes", lambda: 10 * MEGABYTE)
    monkeypatch.setattr(memory, "peak_rss_bytes", lambda: peak[0])
    meter = MemoryMeter("cpu")
    meter.start()
    with meter.excluded():
        peak[0] = 70 * MEGABYTE
    assert meter.peak_bytes() == 60 * MEGABYTE


def test_a_cpu_has_no_reserved_pool():
    assert MemoryMeter("cpu").peak_reserved_bytes() is None
