"""The plan of CAT-3DGS is the published one, and what trains in which phase is what its table says."""

import pytest
import torch
from sw_anchors.coded_anchors import ENTROPY, FULL, QUANTIZED

from splatwizard_core.errors import ConfigError
from splatwizard_core.plugins import load_plugins
from splatwizard_core.runs.config import resolve
from splatwizard_core.training.params import PipelineParams
from splatwizard_core.training.scheduler import build_schedulers, format_plan
from sw_cat_3dgs.config import CatConfig
from sw_cat_3dgs.method import Cat3DGS
from sw_cat_3dgs.stage import CatStage, base_resolution

PLAN = """\
Stage | Task                         | Plan
------+------------------------------+------------------------
Pre   | update lr                    | range(40000)
Pre   | update cam mask              | range(40000)
Pre   | update anchor bound          | 1
Pre   | switch to quantized training | 3000
Pre   | update anchor bound          | 10000
Pre   | setup triplane               | 10000
Pre   | switch to entropy training   | 10001
Pre   | update anchor bound          | 15000
Pre   | train spatial models         | 15000
Pre   | round planes                 | 15001
Pre   | train all but planes         | 16000
Pre   | train everything             | 19000
Post  | collect gradient statistics  | range(15000)
Post  | adjust anchor                | range(1500, 3000, 100)
Post  | adjust anchor                | range(4000, 15000, 100)"""


PAPER = """\
Pre   | update lr                    | range(30000)
Pre   | update cam mask              | range(30000)
Pre   | update anchor bound          | 1
Pre   | switch to quantized training | 3000
Pre   | setup triplane               | 10000
Pre   | switch to entropy training   | 10001
Post  | collect gradient statistics  | range(15000)
Post  | adjust anchor                | range(1500, 3000, 100)
Post  | adjust anchor                | range(4000, 15000, 100)"""
"""The rows that the Splatwizard paper prints; its 30,000 steps are read as all, 40,000 in the authors' code."""
ADDED = """\
Pre   | update anchor bound          | 10000
Pre   | update anchor bound          | 15000
Pre   | train spatial models         | 15000
Pre   | round planes                 | 15001
Pre   | train all but planes         | 16000
Pre   | train everything             | 19000"""
"""Rows that the authors' code does without a task of its own (10000, and the phases from 15000 on), and `rebound`."""


def plan_rows(config):
    return format_plan(*build_schedulers(CatStage(config), PipelineParams())).splitlines()[2:]


def test_the_plan_is_the_papers_rows_and_those_that_are_written_down_as_added():
    paper = PAPER.replace("range(30000)", "range(40000)")
    assert sorted(plan_rows(CatConfig())) == sorted([*paper.splitlines(), *ADDED.splitlines()])


def test_the_whole_plan_in_its_order():
    assert format_plan(*build_schedulers(CatStage(CatConfig()), PipelineParams())) == PLAN


@pytest.mark.parametrize("start", ["network", "statistics"])
def test_the_context_starts_as_published_or_at_the_statistics(scene, method, start):
    from splatwizard_core.streams import stream

    made = method(context__start=start)
    model = made.create_model(scene, stream(0, "init"))
    lasts = [network[2] for network in model.context.slices.networks.values()]
    bounds = [layer.in_features**-0.5 for layer in lasts]
    assert all(layer.weight.abs().max() <= bound for layer, bound in zip(lasts, bounds, strict=True))
    assert all(layer.weight.any() == (start == "network") for layer in lasts)
    (stage,) = made.stages()
    stage.plane_draws = stream(0, "triplane")
    before = model.context.network[2].bias.clone()
    stage.setup_triplane(model, stage.create_optimizer(model, scene))
    assert torch.equal(model.context.network[2].bias, before) == (start == "network")


def test_a_scaled_plan_is_a_fraction_of_forty_thousand():
    stage = CatStage(CatConfig(iterations=800, scale_schedule=True))
    plan = format_plan(*build_schedulers(stage, PipelineParams()))
    for line in ("quantized training | 60", "setup triplane               | 200", "entropy training   | 201",
                 "range(30, 60, 2)", "update lr                    | range(0, 800)"):  # fmt: skip
        assert line in plan.replace("range(800)", "range(0, 800)")
    assert stage.learning_rates(800)["mlp_color"] == pytest.approx(5e-5)


def test_learning_rates_of_the_context():
    stage = CatStage(CatConfig())

    def rates(step):
        found = stage.learning_rates(step)
        return [found[f"context.{name}"] for name in ("triplane", "network", "slices", "arms")]

    curve = 0.008 * (5e-5 / 0.008) ** 0.25  # a quarter of 40,000 steps
    assert rates(10_000) == pytest.approx([0.0075, 0.008, 0.008, 0.005])
    assert rates(15_000)[3] == pytest.approx(0.005)
    assert rates(20_000)[:3] == pytest.approx([curve] * 3)
    assert rates(25_000)[3] == pytest.approx(curve)
    assert stage.learning_rates(40_000)["mlp_color"] == pytest.approx(5e-5)
    assert stage.learning_rates(40_000)["mlp_cov"] == pytest.approx(0.004)


def test_on_bungeenerf_the_rates_of_the_context_decay_until_the_last_step():
    """Its decays take 30,000 steps; those of the context start 10,000 and 15,000 steps late."""
    stage = CatStage(resolve(Cat3DGS, "bungee").config)
    rows = [row.split("|") for row in plan_rows(stage.opt)]
    (plan,) = (row[2].strip() for row in rows if row[1].strip() == "update lr")
    assert plan == "range(40000)"
    rates = stage.learning_rates(39_999)
    late = 0.008 * (5e-5 / 0.008) ** (24_999 / 30_000)
    for name, expected in (("triplane", 5e-5), ("network", 5e-5), ("slices", 5e-5), ("arms", late)):
        assert rates[f"context.{name}"] == pytest.approx(expected, rel=1e-3), name
    assert rates["mlp_color"] == stage.learning_rates(30_000)["mlp_color"] == pytest.approx(5e-5)


def test_the_resolution_follows_the_anchors():
    assert [base_resolution(n, 36) for n in (1, 500, 100_000, 300_000, 800_000)] == [1, 4, 53, 91, 149]


GROUPS = {
    "scene": ("features", "offsets", "log_scales", "mlp_opacity", "mlp_cov", "mlp_color"),
    "context": ("context.network",),
    "slices": ("context.slices",),
    "planes": ("context.triplane",),
    "spatial": ("context.arms",),
}
AFTER = {  # the published step -> what changes in it
    9_999: {"scene"},
    10_000: {"scene"},
    10_001: {"scene", "context", "planes", "slices"},
    14_999: {"scene", "context", "planes", "slices"},
    15_000: set(),
    15_500: {"spatial"},
    16_000: {"scene", "context", "slices", "spatial"},
    17_000: {"scene", "context", "slices", "spatial"},
    19_500: {"scene", "context", "slices", "spatial", "planes"},
}


def digests(model):
    state = {k: v.clone() for k, v in model.state_dict().items()}
    return {g: [v for k, v in state.items() if k.startswith(names)] for g, names in GROUPS.items()}


def changed(before, after):
    found = set()
    for group in GROUPS:
        pairs = zip(before[group], after[group], strict=True)
        if any(a.shape != b.shape or not torch.equal(a, b) for a, b in pairs):
            found.add(group)
    return found


@pytest.mark.parametrize("official", [False, True])
def test_each_phase_trains_what_the_table_says(scene, rasterizer, method, official):
    """A run of 400 steps: published step / 100; growth is off, so that rows stay."""
    from splatwizard_core.streams import Streams, stream
    from splatwizard_core.training.state import TrainingState
    from splatwizard_core.training.trainer import Trainer

    made = method(
        iterations=400, lr__max_steps=400, growth__stop=0, growth__pause_start=0, growth__pause_end=0, growth__start=0,
        phases__quantize=30, phases__triplane=100, phases__warmup=150, phases__scene=160, phases__planes=190,
        phases__official_warmup=official, rate_term__sample=1.0, context__start="network",
    )  # fmt: skip
    (stage,) = made.stages()
    model = made.create_model(scene, stream(0, "init"))
    streams = Streams(0)

    class Context:
        generator = staticmethod(streams)

    Context.model, Context.scene = model, scene
    trainer = Trainer(TrainingState.begin(stage, stage.begin(Context), scene, PipelineParams(), rasterizer, streams))
    phases, watched = {}, {round(s / 100 + (s % 100 > 0) * 0): s for s in AFTER if s % 100 == 0}
    watched |= {99: 9_999, 101: 10_001, 149: 14_999}
    state = {"before": digests(model)}

    def look(record):
        phases[record.step] = model.phase
        after = digests(model)
        if record.step in watched:
            expected = set(AFTER[watched[record.step]])
            if official and 150 <= record.step < 160:
                expected = set()
            # The planes are made at step 100, not trained; the network and the slices stay as they are.
            made = {"planes"} if record.step == 100 else set()
            assert changed(state["before"], after) == expected | made, record.step
        state["before"] = after

    trainer.run(196, look)
    assert [phases[s] for s in (29, 30, 100, 101, 190)] == [FULL, QUANTIZED, QUANTIZED, ENTROPY, ENTROPY]
    assert model.context.rounded
    assert model.context.resolution == base_resolution(model.num_rows, 36)


def test_slices_must_make_up_the_features(method):
    with pytest.raises(ConfigError, match="sum to feature_dim"):
        method(context__slices=[2, 3]).shape()


@pytest.mark.parametrize("name", [*Cat3DGS.PRESETS])
@pytest.mark.parametrize("rate", [*Cat3DGS.RATES])
def test_every_preset_resolves_at_every_rate_point(name, rate):
    config = resolve(Cat3DGS, name, rate).config
    assert config.rate_term.lambda_ == Cat3DGS.RATES[rate]["rate_term.lambda_"]
    Cat3DGS(load_plugins(), config).shape()


def test_rate_points_are_the_papers_and_the_first_makes_the_smallest_file():
    weights = [values["rate_term.lambda_"] for values in Cat3DGS.RATES.values()]
    assert weights == sorted(weights, reverse=True)
    assert sorted(weights) == [0.002, 0.004, 0.01, 0.015, 0.03, 0.04]


def test_the_registry_declares_presets_and_rates():
    entry = load_plugins().methods.entry("cat-3dgs")
    assert entry.declared["presets"] == list(Cat3DGS.PRESETS)
    assert entry.declared["rates"] == list(Cat3DGS.RATES)


def test_a_floor_of_deviations_is_another_training():
    plain = resolve(Cat3DGS, "paper")
    assert plain.config.rate_term.scale_floor == 0  # as published
    raised = resolve(Cat3DGS, "paper", sets={"rate_term.scale_floor": 0.05})
    assert raised.training_hash() != plain.training_hash()
