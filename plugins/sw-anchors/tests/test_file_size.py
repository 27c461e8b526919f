"""Lambda that leads a training to a size, and steps that fill it."""

import math
from types import SimpleNamespace

import pytest
from sw_anchors import file_size
from sw_anchors.file_size import SizeControl, filling_factor

from splatwizard_core.api import ContainerWriter, TaskLog, UserInputError
from splatwizard_core.training.scheduler import Scheduler

STEPS, FIRST = 30_000, 10_000


def led(size: int, *, power: float, lag: float, off: float = 1.1) -> tuple[float, dict[str, float]]:
    """Bytes at the end of a training whose bytes follow lambda by a power, some steps later; state of the control."""
    model = SimpleNamespace(size_control={})
    control = SizeControl(str(size), lambda model: int(off * model.bytes), first=FIRST, steps=STEPS)
    model.bytes = 8e6
    for step in range(control.begin, control.freeze, control.every):
        control.steer(model, step, TaskLog())
        settled = 6e6 * model.size_control["factor"] ** -power
        model.bytes *= (settled / model.bytes) ** (control.every / lag)
    return off * model.bytes, model.size_control


@pytest.fixture(autouse=True)
def _estimate(monkeypatch):
    monkeypatch.setattr(file_size, "estimated_bytes", lambda model: model.bytes)


@pytest.mark.parametrize(("size", "power"), [(5e6, 0.17), (4.5e6, 0.38), (8e6, 0.38), (3.5e6, 0.38)])
def test_the_bytes_come_to_the_size(size: float, power: float):
    found, state = led(int(size), power=power, lag=600)
    assert found == pytest.approx(0.98 * size, rel=0.03)
    assert 1 / 16 < state["factor"] < 16


def test_lambda_stays_in_its_range():
    found, state = led(200_000, power=0.17, lag=600)
    assert state["factor"] == 16
    assert found > 1e6


def test_real_files_correct_the_estimate_a_few_times():
    encodes = []
    model = SimpleNamespace(size_control={}, bytes=1e6)
    control = SizeControl("1MB", lambda model: encodes.append(1) or 1_000_000, first=FIRST, steps=STEPS)
    scheduler = Scheduler("post")
    control.register(scheduler)
    steps = range(control.begin, control.freeze, control.every)
    assert list(scheduler.registrations[0].fires_in(0, STEPS)) == list(steps)
    for step in steps:
        control.steer(model, step, TaskLog())
    assert 3 <= len(encodes) <= file_size.ENCODES + 1
    assert 100 <= len(steps) <= 140


def test_a_log_has_the_curves():
    model, log = SimpleNamespace(size_control={}, bytes=2e6), TaskLog()
    SizeControl("1MB", lambda model: 2_000_000, first=FIRST, steps=STEPS).steer(model, 11_000, log)
    assert set(log.scalars) == {"file bytes", "lambda factor"}


def writes(fixed: int, numbers: int, power: float):
    def write(writer: ContainerWriter, factor: float) -> None:
        writer.add("values", bytes(int(fixed + numbers * factor**-power)))

    return write


@pytest.mark.parametrize("share", [0.9, 1.1, 0.75, 0.999, 1.0])
def test_steps_fill_a_size(share: float):
    write, like = writes(20_000, 180_000, 0.5), ContainerWriter("hac", 1)
    size = int(200_000 * share)
    factor = filling_factor(write, like, str(size))
    writer = ContainerWriter("hac", 1)
    write(writer, factor)
    assert 0.97 * size < len(writer.to_bytes()) + file_size.HEADER <= size
    assert math.copysign(1, factor - 1) == (1 if share <= 1.0 else -1)


def test_no_size_leaves_the_steps():
    assert filling_factor(writes(1, 1, 1), ContainerWriter("hac", 1), "") == 1.0


def test_a_size_out_of_reach_names_the_smallest():
    with pytest.raises(UserInputError, match="no file of 10,000 bytes was found: the smallest of this training has"):
        filling_factor(writes(20_000, 180_000, 0.5), ContainerWriter("hac", 1), "10kB")
