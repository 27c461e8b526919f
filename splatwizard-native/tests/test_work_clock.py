"""The clock of the work alone stands still while modules are compiled or loaded."""

from __future__ import annotations

import pytest

from splatwizard_native import loading_time, work_clock, work_time
from splatwizard_native.module import NativeModule


class Clock:
    """A clock that the test moves."""

    now = 100.0

    def perf_counter(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(work_clock, "time", clock)
    monkeypatch.setattr(work_clock, "_loading_s", 0.0)
    return clock


def test_it_goes_with_the_wall_clock_but_for_loading(clock: Clock):
    began = work_time()
    clock.now += 2
    with work_clock.loading():
        clock.now += 30
    clock.now += 1
    assert work_time() - began == 3
    assert loading_time() == 30


def test_loading_that_fails_counts_too(clock: Clock):
    def fails() -> None:
        with work_clock.loading():
            clock.now += 7
            raise ValueError("no compiler")

    with pytest.raises(ValueError, match="no compiler"):
        fails()
    assert loading_time() == 7


def test_a_module_is_loaded_on_that_account_and_asked_again_for_nothing(clock: Clock, monkeypatch: pytest.MonkeyPatch):
    def loads(self: NativeModule, say: object) -> None:
        clock.now += 4
        self._session.loaded = self.prebuilt_folder

    monkeypatch.setattr(NativeModule, "_load", loads)
    module = NativeModule("a_module", "splatwizard_native", "face.h", ("nothing.cpp",))
    module.load()
    module.load()
    assert loading_time() == 4
