"""Lambda that leads a training to a size, and steps that fill it."""

from types import SimpleNamespace

import pytest
from sw_compress import lambda_control
from sw_compress.lambda_control import LeadToSize

from splatwizard_core.api import TaskLog, UserInputError

STEPS, FIRST = 30_000, 10_000


def stepped(**parts) -> SimpleNamespace:
    return SimpleNamespace(**{"led": {}, "STEP_POWERS": (1, 1, 1), **parts})


def led(size: int, *, power: float, lag: float, off: float = 1.1) -> tuple[float, dict[str, float]]:
    """Bytes at the end of a training whose bytes follow lambda by a power, some steps later; state of the control."""
    model = stepped()
    control = LeadToSize(str(size), "hac", FIRST, STEPS)
    model.bytes = 8e6
    for step in range(control.begin, control.freeze, control.every):
        control.steer(model, lambda: int(off * model.bytes), step, TaskLog())
        settled = 6e6 * control.factor**-power
        model.bytes *= (settled / model.bytes) ** (control.every / lag)
    return off * model.bytes, control.state


@pytest.fixture(autouse=True)
def _estimate(monkeypatch):
    monkeypatch.setattr(lambda_control, "estimated_bytes", lambda model, result: model.bytes)


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
    model = stepped(bytes=1e6)
    task = LeadToSize("1MB", "hac", FIRST, STEPS)
    for step in task.steps[1:-1]:
        task.steer(model, lambda: encodes.append(1) or 1_000_000, step, TaskLog())
    assert 3 <= len(encodes) <= lambda_control.ENCODES + 1
    assert (*task.steps[:2], task.steps[-1]) == (1, 11_000, STEPS)
    assert 100 <= len(task.steps) <= 140


def test_a_log_has_the_curves():
    model, log = stepped(bytes=2e6), TaskLog()
    LeadToSize("1MB", "hac", FIRST, STEPS).steer(model, lambda: 2_000_000, 11_000, log)
    assert set(log.scalars) == {"file bytes", "lambda factor"}


def filled(size: int, **parts) -> tuple[int, list[float]]:
    """Bytes of a file of 20,000 fixed ones and 180,000 that fall with the root of the steps, and those factors."""
    model = stepped(**parts)

    def written() -> int:
        return int(20_000 + 180_000 * model.led["steps"][1] ** -0.5)

    LeadToSize(str(size), "hac", FIRST, STEPS).fill(model, written, TaskLog())
    return written(), model.led["steps"]


@pytest.mark.parametrize("share", [0.9, 1.1, 0.75, 0.999, 1.0])
def test_steps_fill_a_size(share: float):
    size = int(200_000 * share)
    found, steps = filled(size)
    assert 0.97 * size < found + lambda_control.HEADER <= size
    assert (steps[0] > 1) == (share <= 1)
    assert steps[0] == steps[1] == steps[2]


def test_features_keep_the_step_that_a_network_has_learnt():
    _, steps = filled(180_000, STEP_POWERS=(0, 1, 1))
    assert steps[0] == 1 < steps[1]


def test_a_size_out_of_reach_names_the_smallest():
    with pytest.raises(UserInputError, match="no file of 10,000 bytes was found: the smallest of this training has"):
        filled(10_000)
