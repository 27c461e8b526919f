"""benchmarks/watch_cost.py: what drifts cancels, what the watch costs does not, and the interval holds it."""

from __future__ import annotations

import importlib.util
import math
from pathlib import Path
from types import ModuleType
from typing import Any, NoReturn

import pytest

from splatwizard_native import waiting

SCRIPT = Path(__file__).parents[1] / "benchmarks" / "watch_cost.py"
MEASURED = 60.0  # s


@pytest.fixture
def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("watch_cost", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class FakeWork:
    """Units that take 10 ms at first, `growth` of that more each second, and `cost` times as long while watched."""

    def __init__(self, script: ModuleType, monkeypatch: pytest.MonkeyPatch, cost: float, growth: float) -> None:
        self.now, self.watched, self.cost, self.growth = 0.0, False, cost, growth
        work = self

        class Watch:
            def __init__(self) -> None:
                assert not work.watched
                work.watched = True

            def end(self) -> None:
                work.watched = False

        monkeypatch.setattr(waiting, "Watch", Watch)
        monkeypatch.setattr(script.time, "perf_counter", lambda: self.now)
        monkeypatch.setattr(script, "cpu_seconds", lambda: 2 * self.now)

    def unit(self) -> None:
        self.now += 0.01 * (1 + self.growth * self.now) * (self.cost if self.watched else 1)

    def go_on(self, blocks: Any) -> NoReturn:
        while True:
            self.unit()
            blocks.unit_done()


@pytest.mark.parametrize(("cost", "growth"), [(1.0, 0.0), (1.0, 0.02), (1.05, 0.02)])
def test_the_ratio_is_what_the_watch_costs_whatever_drifts(script, monkeypatch, cost, growth):
    with monkeypatch.context() as patch:
        work = FakeWork(script, patch, cost, growth)
        blocks = script.Blocks(seconds=MEASURED, block=0.5)
        with pytest.raises(script.Enough):
            work.go_on(blocks)
        assert not work.watched
    assert work.now > script.WARM_UP + MEASURED
    assert {tuple(on for on, _ in four) for four in blocks.fours} == {
        (True, False, False, True),
        (False, True, True, False),
    }
    for which in (0, 1):
        ratio, low, high = script.interval(blocks.ratios(which))
        assert low <= ratio <= high
        assert ratio == pytest.approx(cost, abs=2e-3)


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("--jobs", "train,trian", "no job 'trian', choose from train, plain, decode"),
        ("--looks", "0", "'0' is no number above 0"),
        ("--block", "-1", "'-1' is no number above 0"),
        ("--seconds", "nan", "'nan' is no number above 0"),
    ],
)
def test_a_wrong_option_is_refused_before_anything_runs(script, monkeypatch, capsys, option, value, message):
    monkeypatch.setattr(script, "rows", lambda *_: pytest.fail("measures"))
    monkeypatch.setattr(script.os, "sched_setaffinity", lambda *_: None)
    monkeypatch.setattr(script.sys, "argv", ["watch_cost.py", option, value])
    with pytest.raises(SystemExit, match="2"):
        script.main()
    assert message in capsys.readouterr().err


def test_a_new_training_begins_a_new_four_without_the_watch(script, monkeypatch):
    work = FakeWork(script, monkeypatch, cost=1.0, growth=0.0)
    blocks = script.Blocks(seconds=MEASURED, block=0.5)
    while work.now < 20 or not work.watched:
        work.unit()
        blocks.unit_done()
    complete = len(blocks.fours)
    blocks.begin_anew()
    assert not work.watched
    while len(blocks.fours) == complete:
        work.unit()
        blocks.unit_done()
    assert len(blocks.fours[-1]) == 4


def test_the_interval_narrows_with_the_number_of_fours(script):
    logs = [math.log(1.02) + 0.05 * (-1) ** i for i in range(200)]
    few, many = script.interval(logs[:10]), script.interval(logs)
    assert few[0] == pytest.approx(many[0]) == pytest.approx(1.02)
    assert many[1] < 1.02 < many[2]
    assert few[2] - few[1] > 3 * (many[2] - many[1])
