"""The progress display away from a terminal, and its cost."""

import io
import sys
from types import FrameType

import pytest

from splatwizard_core.base import progress
from splatwizard_core.base.progress import duration, track


@pytest.fixture
def now(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The clock of all bars, seconds; it stands still until a test moves it."""
    now = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    return now


def test_a_blink_of_an_eye_prints_nothing(now: list[float]):
    out = io.StringIO()
    with track("encode", total=3, stream=out) as bar:
        for _ in range(3):
            bar.advance()
        now[0] += 0.9
    assert out.getvalue() == ""
    with track("encode", total=3, stream=out) as bar:
        now[0] += 1.0
    assert out.getvalue() == "encode: 0 in 1.0 s\n"


def test_plain_lines_show_count_rate_loss_gaussians_and_time_left(now: list[float]):
    out = io.StringIO()
    with track("train 3dgs", total=100, start=20, stream=out) as bar:
        for _ in range(60):
            now[0] += 0.2
            bar.advance(1, loss=0.03125, gaussians=120_331)
    lines = out.getvalue().splitlines()
    assert lines[0] == "train 3dgs: 45/100 · 5.0 it/s · loss 0.03125 · 120,331 Gaussians · 11.0 s left"
    assert len(lines) == 3  # every five seconds of twelve, and the last one
    assert lines[-1] == "train 3dgs: 80 in 12.0 s · 5.0 it/s · loss 0.03125 · 120,331 Gaussians"


def test_steps_of_an_earlier_process_do_not_count_for_the_rate(now: list[float]):
    with track("t", total=1000, start=900, stream=io.StringIO()) as bar:
        assert bar.rate is None
        assert bar.seconds_left is None
        now[0] += 2.0
        bar.advance(4)
        assert bar.rate == pytest.approx(2.0)
        assert bar.seconds_left == pytest.approx(48.0)


def test_values_are_read_only_when_they_are_shown(now: list[float]):
    class Costly:
        read = 0

        def __float__(self) -> float:
            Costly.read += 1
            return 1.0

    with track("t", total=1000, stream=io.StringIO()) as bar:
        for _ in range(1000):
            now[0] += 0.012
            bar.advance(1, loss=Costly())
        assert Costly.read == 2  # every five seconds of twelve
    assert Costly.read == 3


def test_advancing_is_cheap(now: list[float]):
    """It calls the clock and no other function of Python's; a step of training calls hundreds."""
    called: list[str] = []

    def note(frame: FrameType, event: str, _: object) -> None:
        if event == "call":
            called.append(frame.f_code.co_name)

    with track("t", stream=io.StringIO()) as bar:
        before = sys.getprofile()
        sys.setprofile(note)
        for _ in range(100):
            bar.advance(1, loss=0.5, gaussians=10)
        sys.setprofile(before)
    assert called == ["advance", "<lambda>"] * 100  # the clock of this test


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_terminal_gets_a_bar_with_the_same_facts_and_nested_bars_share_it(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("COLUMNS", "140")
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(progress, "REFRESH_SECONDS", 0.0)
    monkeypatch.setattr(progress._RichBar, "_interval", 0.0)
    out = Terminal()
    with track("train [red]", total=10, stream=out) as bar:
        bar.advance(4, loss=0.25, gaussians=1234)
        with track("evaluate", total=2, unit="views", stream=out) as inner:
            inner.advance(1, PSNR=30.5)
            inner.say("pruned [3] of 5")
        bar.advance(6)
    text = out.getvalue()
    assert "pruned [3] of 5\x1b" in text or "pruned [3] of 5\n" in text  # a line of its own, above the bars
    for part in ("train [red]", "4/10", "loss 0.25", "1,234 Gaussians", "evaluate", "PSNR 30.5", "10/10"):
        assert part in text


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.04, "0.0 s"), (59.4, "59.4 s"), (60, "1 min 00 s"), (245, "4 min 05 s"), (7380, "2 h 03 min")],
)
def test_durations(seconds: float, text: str):
    assert duration(seconds) == text


def foretold(now: list[float], seconds: float, total: int, steps: int, **options: bool) -> list[str]:
    """Lines that foretell something, of so many steps of `seconds` each; the first takes a minute."""
    out = io.StringIO()
    with track("train 3dgs", total=total, stream=out, **options) as bar:
        for i in range(steps):
            now[0] += seconds if i else 60.0
            bar.advance()
    return [line for line in out.getvalue().splitlines() if "just measured" in line]


def test_a_long_run_is_foretold_once_from_the_first_steps_without_the_one_that_warms_up(now: list[float]):
    assert foretold(now, 0.125, 30_000, 300, foretells=True) == [
        "train 3dgs: about 1 h 02 min for the 29,967 steps that are left, by the 32 just measured "
        "(more as a model grows)"
    ]
    assert foretold(now, 30.0, 100, 10, foretells=True) == [
        "train 3dgs: about 48 min 00 s for the 96 steps that are left, by the 3 just measured (more as a model grows)"
    ]


def test_what_does_not_take_long_or_is_no_training_is_not_foretold(now: list[float]):
    assert foretold(now, 0.125, 900, 600, foretells=True) == []
    assert foretold(now, 0.125, 30_000, 300) == []
