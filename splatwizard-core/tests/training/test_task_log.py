"""Tasks that say something and record curves: in the terminal, in log.jsonl, for observers; once, resumed or not."""

import json
import math
from copy import copy

import pytest
import torch

from splatwizard_core.errors import TaskError
from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.training.params import OptimizationParams, PipelineParams
from splatwizard_core.training.task_log import TaskLog


def count_rows(model: GaussianModel, log: TaskLog, step: int) -> None:
    log.say(f"{model.num_rows} rows\nnow")
    log.scalar("rows", model.num_rows)
    log.scalar("mean opacity", model.opacities.mean())


def lines_of(path):
    return [json.loads(line) for line in (path / "log.jsonl").read_text().splitlines()]


@pytest.fixture
def talking(toy):
    """The toy's stage with a task that talks every 15 steps, before rendering and after."""

    class Talking(toy.Stage):
        def register_pre_task(self, scheduler, ppl, opt):
            super().register_pre_task(scheduler, ppl, opt)
            scheduler.register_task(range(0, 100, 30), _early)

        def register_post_task(self, scheduler, ppl, opt):
            super().register_post_task(scheduler, ppl, opt)
            scheduler.register_task(range(0, 100, 15), count_rows)

    return lambda iterations=60: [Talking(OptimizationParams(iterations=iterations))]


def _early(log: TaskLog) -> None:
    log.scalar("early", 0.1)


def test_lines_and_curves_stand_in_the_log(toy, talking, tmp_path, capsys):
    ppl = PipelineParams(log_every=30)
    toy.train(talking(), directory=tmp_path, ppl=ppl)
    lines = lines_of(tmp_path)
    said = [(x["step"], x["task"], x["said"]) for x in lines if "said" in x]
    assert [(step, task) for step, task, _ in said] == [(s, "count rows") for s in (15, 30, 45, 60)]
    curves = {x["step"]: x["scalars"] for x in lines if "scalars" in x}
    assert [s for s, found in curves.items() if "early" in found] == [30, 60]
    assert [s for s, found in curves.items() if "rows" in found] == [15, 30, 45, 60]
    assert curves[30]["early"] == 0.1  # not 0.1 as a float32
    counted = {x["step"]: x["num_gaussians"] for x in lines if "loss" in x}
    assert curves[60]["rows"] == counted[60]
    assert 0 < curves[60]["mean opacity"] < 1
    assert [x["step"] for x in lines if "loss" in x] == [1, 15, 30, 45, 60]  # a curve's steps are logged whole
    assert all(x["stage"] == 0 for x in lines)


def test_what_a_task_says_is_one_line_in_the_terminal(toy, talking, capsys):
    toy.train(talking(20))
    told = [line for line in capsys.readouterr().err.splitlines() if "count rows" in line]
    assert len(told) == 1
    assert told[0].startswith("step 15, count rows: ")
    assert told[0].endswith(" rows now")


def test_an_observer_gets_both(toy, talking):
    records = {}
    toy.train(talking(30), on_step=lambda _, state: records.update({state.step: copy(state)}))
    assert records[15].said[-1][0] == "count rows"
    assert set(records[30].scalars) == {"early", "rows", "mean opacity"}
    assert records[30].scalars["rows"].item() > 0
    assert not records[16].said
    assert not records[16].scalars


def test_a_resumed_run_repeats_nothing(toy, talking, tmp_path):
    def fail(_, record):
        if record.step == 58:
            raise RuntimeError

    ppl = PipelineParams(checkpoint_every=40)
    with pytest.raises(RuntimeError):
        toy.train(talking(90), directory=tmp_path / "a", ppl=ppl, on_step=fail)
    assert [x["step"] for x in lines_of(tmp_path / "a") if "scalars" in x] == [15, 30, 45]
    toy.train(talking(90), directory=tmp_path / "a", ppl=ppl)
    toy.train(talking(90), directory=tmp_path / "b", ppl=ppl)
    assert (tmp_path / "a" / "log.jsonl").read_text() == (tmp_path / "b" / "log.jsonl").read_text()
    assert [x["step"] for x in lines_of(tmp_path / "a") if "scalars" in x] == [15, 30, 45, 60, 75, 90]


def test_a_value_is_that_of_its_step_and_the_last_one_counts():
    log, moving = TaskLog(), torch.ones(1)
    log.scalar("a", moving)
    moving.zero_()
    assert log.scalars["a"].item() == 1
    log.scalar("a", 3)
    assert log.scalars["a"].item() == 3
    log.scalar("b", math.inf)
    assert log.scalars["b"].dtype == torch.float64


@pytest.mark.parametrize(("name", "value"), [("", 1.0), ("rows", torch.ones(2)), ("rows", torch.ones(0))])
def test_what_is_no_point_of_a_curve_is_refused(name, value):
    with pytest.raises(ValueError, match="one number per step"):
        TaskLog().scalar(name, value)


def test_a_bad_value_names_the_task_and_the_step(toy):
    def measure(log: TaskLog) -> None:
        log.scalar("errors", torch.zeros(3))

    class Wrong(toy.Stage):
        def register_post_task(self, scheduler, ppl, opt):
            scheduler.register_task(7, measure)

    with pytest.raises(TaskError, match=r"'measure' .* failed at step 7"):
        toy.train([Wrong(OptimizationParams(iterations=20))])


def test_a_value_that_is_not_finite_is_null_in_the_log(toy, tmp_path):
    def measure(log: TaskLog) -> None:
        log.scalar("ratio", math.nan)

    class Odd(toy.Stage):
        def register_post_task(self, scheduler, ppl, opt):
            scheduler.register_task(3, measure)

    toy.train([Odd(OptimizationParams(iterations=5))], directory=tmp_path)
    assert [x["scalars"] for x in lines_of(tmp_path) if "scalars" in x] == [{"ratio": None}]
