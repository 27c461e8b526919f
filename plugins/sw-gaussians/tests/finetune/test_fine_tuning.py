"""Training on from a trained scene: the step sizes at every step, what it starts with, and the plan."""

import math

import pytest
import torch
from sw_gaussians.finetune.fine_tuning import (
    FineTuningRates,
    FineTuningStage,
    UpdateRates,
    clear_statistics,
    collect_anew,
    collect_statistics,
    windows_before,
)

from splatwizard_core.training.optimizer import ParamGroup, SplatOptimizer
from splatwizard_core.training.params import OptimizationParams
from splatwizard_core.training.scheduler import build_schedulers

PUP = FineTuningRates(position_init=1.6e-4, position_final=1.6e-6, position_offset=30_000, max_steps=35_000, decay=0.95)


def test_by_default_the_means_move_at_the_end_of_the_schedule_of_3dgs():
    for step in (0, 1, 15_000, 40_000):
        assert FineTuningRates().of_step(step, 2.0)["means"] == pytest.approx(3.2e-6, rel=1e-12)


def test_the_published_rates_of_a_round_of_5000():
    # 3.09e-6 at its first step, 1.6e-6 at its last, times the extent.
    assert PUP.of_step(1, 1.0)["means"] == pytest.approx(3.09e-6, rel=2e-3)
    assert PUP.of_step(5000, 1.0)["means"] == pytest.approx(1.6e-6, rel=1e-9)
    assert PUP.of_step(399, 1.0)["opacity_logits"] == 0.05
    assert PUP.of_step(400, 1.0)["opacity_logits"] == pytest.approx(0.05 * 0.95)
    assert PUP.of_step(5000, 1.0)["quats"] == pytest.approx(1e-3 * 0.95**12)


def test_a_second_round_begins_anew_and_a_shorter_run_decays_as_fast_as_a_full_one(toy):
    model = toy.make_model(toy.scene)
    optimizer = SplatOptimizer(model, [ParamGroup("means", 0.0), ParamGroup("quats", 0.0)])
    task = UpdateRates(PUP, starts=(1, 501), scale=0.1)
    seen = {}
    for step in (1, 40, 500, 501, 540, 1000):
        task(optimizer, toy.scene, step)
        seen[step] = (optimizer.lr("means") / toy.scene.extent, optimizer.lr("quats"))
    assert seen[40] == seen[540]
    assert seen[500] == seen[1000]
    assert seen[40][1] == pytest.approx(1e-3 * 0.95)
    assert seen[500][0] == pytest.approx(1.6e-6)
    assert seen[1] == seen[501]
    assert seen[501][0] > seen[500][0]


class Params(OptimizationParams):
    FULL_ITERATIONS = 5_000


class Recording(FineTuningStage):
    name = "tuning"
    starts_from = "3dgs"
    statistics = True

    def register_post_task(self, scheduler, ppl, opt):
        scheduler.register_task(self.when(range(100)), collect_statistics, name="collect gradient statistics")


def test_the_plan_is_printed_and_scaled():
    stage = Recording(Params(iterations=500, scale_schedule=True), FineTuningRates())
    assert stage.opt.schedule_scale == pytest.approx(0.1)
    pre, post = build_schedulers(stage, None)
    assert [r.name for r in pre.registrations] == ["update lr"]
    assert pre.registrations[0].when == range(3000)
    assert post.registrations[0].when == range(10)


def test_step_sizes_are_set_to_the_end_of_a_stage_that_is_longer_than_the_published_one():
    pre, _ = build_schedulers(Recording(Params(iterations=40_000), FineTuningRates()), None)
    assert pre.registrations[0].when == range(40_000)
    pre, _ = build_schedulers(Recording(Params(iterations=10), FineTuningRates()), None)
    assert pre.registrations[0].when == range(30_000)


def test_a_stage_starts_from_the_trained_scene_with_all_bands_and_fresh_statistics(toy):
    trained = toy.make_model(toy.scene)
    trained.active_sh_degree = 0
    trained.denom += 3
    outcome = toy.train(
        [Recording(Params(iterations=20), FineTuningRates(position_init=1e-3, position_final=1e-3))],
        trained=lambda name: {"3dgs": trained}[name],
    )
    assert outcome.model.active_sh_degree == trained.max_sh_degree
    assert trained.active_sh_degree == 0
    assert float(outcome.model.denom.max()) == 20  # one a step, and none of the 3
    assert float(outcome.model.grad_accum.max()) > 0
    assert not torch.equal(outcome.model.means, trained.means)
    assert math.isfinite(float(outcome.model.means.sum()))


@pytest.mark.parametrize(
    ("removals", "length", "windows"),
    [
        ([100, 600], 99, [range(1, 100), range(501, 600)]),
        ([100, 150], 99, [range(1, 100), range(101, 150)]),  # not behind the removal at 100
        ([1, 2, 5], 3, [range(1, 2), range(2, 3), range(3, 5)]),  # the first two have their own step alone
        ([], 9, []),
    ],
)
def test_gradients_are_those_of_the_steps_before_each_removal(removals, length, windows):
    assert windows_before(removals, length) == windows


class Anew(FineTuningStage):
    name = "anew"
    statistics = True

    def register_post_task(self, scheduler, ppl, opt):
        collect_anew(scheduler, windows_before([4, 9], 3))


def test_each_window_begins_with_sums_of_its_own(toy):
    stage = Anew(Params(iterations=12), FineTuningRates())
    _, post = build_schedulers(stage, None)
    plan = {step: [r.task for r in post.registrations if r.due(step)] for step in range(1, 13)}
    assert [step for step in plan if clear_statistics in plan[step]] == [1, 6]
    assert [step for step in plan if collect_statistics in plan[step]] == [1, 2, 3, 6, 7, 8]
    assert plan[6] == [clear_statistics, collect_statistics]
    outcome = toy.train([stage], trained=lambda name: toy.make_model(toy.scene))
    assert float(outcome.model.denom.max()) == 3
