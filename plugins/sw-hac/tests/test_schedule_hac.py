"""The plan of HAC is the published one, line by line."""

import pytest
from sw_anchors.coded_anchors import ENTROPY, FULL, QUANTIZED

from splatwizard_core.plugins import load_plugins
from splatwizard_core.runs.config import resolve
from splatwizard_core.training.params import PipelineParams
from splatwizard_core.training.scheduler import build_schedulers, format_plan
from splatwizard_core.training.tasks import TaskContext
from sw_hac.config import HACConfig
from sw_hac.method import HAC, HACStage

PAPER = """\
Pre   | update lr                    | range(30000)
Pre   | update anchor bound          | 1
Post  | collect gradient statistics  | range(15000)
Post  | adjust anchor                | range(1500, 3000, 100)
Post  | adjust anchor                | range(4000, 15000, 100)
Post  | switch to quantized training | 3000
Post  | switch to entropy training   | 10001"""
"""The rows that the Splatwizard paper prints."""
ADDED = "Post  | update anchor bound          | 10000"
"""In the authors' code a part of that step's forward pass."""


def plan_of(stage):
    return build_schedulers(stage, PipelineParams())


def steps_of(stage, name: str) -> list[int]:
    pre, post = plan_of(stage)
    total = stage.iterations
    return [s for r in (*pre.registrations, *post.registrations) if r.name == name for s in r.fires_in(0, total)]


def test_the_plan_is_the_papers_rows_and_the_one_that_is_written_down_as_added():
    rows = format_plan(*plan_of(HACStage(HACConfig()))).splitlines()[2:]
    assert [row for row in rows if row != ADDED] == PAPER.splitlines()
    assert rows.count(ADDED) == 1


def test_the_steps_are_the_published_ones():
    stage = HACStage(HACConfig())
    assert steps_of(stage, "update lr") == list(range(1, 30_000))
    assert steps_of(stage, "update anchor bound") == [1, 10_000]
    assert steps_of(stage, "collect gradient statistics") == list(range(1, 15_000))
    assert steps_of(stage, "adjust anchor") == [*range(1500, 3000, 100), *range(4000, 15_000, 100)]
    assert len(steps_of(stage, "adjust anchor")) == 15 + 110
    assert steps_of(stage, "switch to quantized training") == [3000]
    assert steps_of(stage, "switch to entropy training") == [10_001]


def test_a_plan_scaled_to_a_fiftieth():
    stage = HACStage(HACConfig(iterations=600, scale_schedule=True))
    assert steps_of(stage, "adjust anchor") == [*range(30, 60, 2), *range(80, 300, 2)]
    assert steps_of(stage, "switch to quantized training") == [60]
    assert steps_of(stage, "switch to entropy training") == [200]


def test_the_phases_follow_one_another():
    from hac_models import make

    model, stage = make(n=20), HACStage(HACConfig())
    model.phase = FULL
    _, post = plan_of(stage)
    switches = [r for r in post.registrations if r.name.startswith("switch")]
    context = TaskContext(PipelineParams(), stage.opt, model, None, None, None, None)
    phases = []
    for registration in switches:
        registration.task(context.model)
        phases.append(model.phase)
    assert phases == [QUANTIZED, ENTROPY]


def test_rate_points_are_the_published_weights():
    weights = {name: values["rate_term.weight"] for name, values in HAC.RATES.items()}
    assert weights == {"r1": 0.004, "r2": 0.003, "r3": 0.002, "r4": 0.001, "r5": 0.0005}
    assert HAC.RATES[HAC.DEFAULT_RATE]["rate_term.weight"] == HACConfig().rate_term.weight
    entry = load_plugins().methods.entry("hac")
    assert list(entry.declared["presets"]) == list(HAC.PRESETS)
    assert list(entry.declared["rates"]) == list(HAC.RATES)


def test_learning_rates_of_grid_and_network_decay():
    stage = HACStage(HACConfig())
    for step, expected in ((0, 0.005), (30_000, 1e-5)):
        rates = stage.learning_rates(step)
        assert (rates["grid"], rates["mlp_grid"]) == pytest.approx((expected, expected))


def test_every_preset_resolves_and_ends_in_the_entropy_phase():
    for preset in HAC.PRESETS:
        config = resolve(HAC, preset).config
        stage = HACStage(config)
        switch = steps_of(stage, "switch to entropy training")
        assert len(switch) == 1
        assert steps_of(stage, "switch to quantized training")[0] < switch[0] < config.iterations
        assert max(steps_of(stage, "adjust anchor")) < config.iterations


def test_cells_that_are_whole_voxels_anyway_tell_no_trainings_apart():
    plain = resolve(HAC, "paper").training_hash()
    assert resolve(HAC, "paper", sets={"growth.subvoxel": True}).training_hash() == plain
    fractions = [resolve(HAC, "paper", sets={"growth.init_factor": 4, "growth.subvoxel": on}) for on in (False, True)]
    assert len({each.training_hash() for each in fractions} | {plain}) == 3
