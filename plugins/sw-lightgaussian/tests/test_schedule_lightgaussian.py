"""The plan of both stages is the published one, and so are the step sizes."""

from types import SimpleNamespace

import pytest
import torch
from sw_gaussians.finetune.fine_tuning import FineTuningStage
from sw_gaussians.start import gaussians_from_points

from splatwizard_core.api import PointCloud
from splatwizard_core.errors import ConfigError
from splatwizard_core.runs.config import apply_overrides, resolve
from splatwizard_core.training.params import PipelineParams
from splatwizard_core.training.scheduler import build_schedulers, format_plan
from sw_lightgaussian.config import LightGaussianConfig
from sw_lightgaussian.method import LightGaussian
from sw_lightgaussian.significance import Significance
from sw_lightgaussian.stages import PruneStage

PRUNE_PLAN = """\
Stage | Task      | Plan
------+-----------+------------
Pre   | update lr | range(5000)
Post  | prune     | 1"""

DISTILL_PLAN = """\
Stage | Task                       | Plan
------+----------------------------+------------
Pre   | update lr                  | range(5000)
Post  | calculate importance score | 5000"""


@pytest.fixture
def stages(plugins):
    def make(**values):
        values = {key.replace("__", "."): value for key, value in values.items()}
        return LightGaussian(plugins, apply_overrides(LightGaussianConfig(), values, source="test")).stages()

    return make


def plan(stage):
    pre, post = build_schedulers(stage, PipelineParams())
    return {r.name: str(r.when) for r in (*pre.registrations, *post.registrations)}


def test_the_plans_are_the_published_tables(stages):
    prune, distill = stages()
    for stage, expected in ((prune, PRUNE_PLAN), (distill, DISTILL_PLAN)):
        pre, post = build_schedulers(stage, PipelineParams())
        assert format_plan(pre, post) == expected
        assert stage.iterations == 5000
    assert (prune.starts_from, distill.starts_from, distill.taught_by) == ("3dgs", None, ("3dgs",))


def test_the_rates_are_those_of_the_authors_schedule(stages):
    prune, distill = (stage.rates for stage in stages())
    assert prune.of_step(1, 1.0)["means"] == pytest.approx(3.09e-6, rel=2e-3)
    assert distill.of_step(1, 1.0)["means"] == pytest.approx(2.84e-6, rel=2e-3)
    for rates in (prune, distill):
        assert rates.of_step(5000, 2.0)["means"] == pytest.approx(3.2e-6, rel=1e-9)
    first = {"sh_dc": 0.0025, "sh_rest": 0.000125, "log_scales": 0.005, "quats": 0.001}
    for name, rate in first.items():
        assert prune.of_step(399, 1.0)[name] == distill.of_step(499, 1.0)[name] == rate
        assert prune.of_step(4800, 1.0)[name] == pytest.approx(rate * 0.95**12)
        assert distill.of_step(5000, 1.0)[name] == pytest.approx(rate * 0.90**10)
    assert prune.of_step(1, 1.0)["opacity_logits"] == 0.05
    assert distill.of_step(1, 1.0)["opacity_logits"] == 0  # frozen


def test_preset_paper_counts_as_the_authors_kernel_does_and_only_for_its_own_score(plugins):
    config = resolve(LightGaussian, "paper", plugins=plugins).config
    for block in (config.prune, config.score):
        assert (block.settings["kind"], block.settings["v_pow"]) == ("v_tile_score", 0.1)
    other = resolve(LightGaussian, "paper", sets={"prune.pruner": "opacity"}, plugins=plugins).config
    assert (other.prune.settings, other.score.settings["kind"]) == ({}, "v_tile_score")


def test_pruning_happens_at_the_first_step_by_the_published_share_and_may_decay(stages):
    assert stages()[0].fractions() == {1: 0.66}
    assert stages(prune__steps=[100, 1], prune__percent=0.5, prune__decay=0.6)[0].fractions() == {1: 0.5, 100: 0.3}


def test_a_shorter_run_scales_both_stages(stages):
    prune, distill = stages(iterations=500, scale_schedule=True, prune__steps=[1, 2000])
    assert (prune.iterations, distill.iterations) == (500, 500)
    assert plan(prune) == {"update lr": "range(0, 500)", "prune": "[1, 200]"}
    assert plan(distill) == {"update lr": "range(0, 500)", "calculate importance score": "500"}
    assert stages(prune__iterations=2500, iterations=500, scale_schedule=True)[0].iterations == 250


def test_the_score_belongs_to_the_last_step_however_many_there_are(stages):
    prune, distill = stages(iterations=70)
    assert plan(distill)["calculate importance score"] == "70"
    assert prune.iterations == 70  # a run that is cut short is short


@pytest.mark.parametrize("steps", [[0], [1, 2]])
def test_steps_that_fall_together_are_an_error(stages, steps):
    stage = stages(iterations=50, scale_schedule=True, prune__steps=steps)[0]
    with pytest.raises(ConfigError, match=r"prune\.steps"):
        build_schedulers(stage, PipelineParams())


@pytest.mark.parametrize("steps", [[3, 3], [-1], [0, 5]])
def test_steps_that_make_no_plan_are_an_error_in_a_full_run_too(stages, steps):
    with pytest.raises(ConfigError, match=r"prune\.steps"):
        stages(prune__steps=steps)[0].fractions()


@pytest.mark.parametrize("iterations", [1, 2, 3])
def test_a_run_of_hardly_any_steps_still_prunes_and_scores(stages, iterations):
    prune, distill = stages(iterations=iterations, scale_schedule=True)
    assert (prune.iterations, distill.iterations) == (iterations, iterations)
    assert plan(prune)["prune"] == "1"
    assert plan(distill)["calculate importance score"] == str(iterations)


def test_an_unknown_codec_is_told_before_anything_is_trained(stages):
    with pytest.raises(ConfigError, match=r"no coder is called 'zip'; installed: .*vectree") as told:
        stages(codec__name="zip")
    assert told.value.key == "codec.name"


class Statistical:
    uses_statistics = True

    def score(self, model, cameras, rasterizer, background=None):
        return torch.arange(float(model.num_rows))


def test_a_pruner_that_wants_gradient_statistics_has_them_collected(plugins):
    from sw_lightgaussian.stages import PruneStage

    config = apply_overrides(LightGaussianConfig(), {"prune.steps": [100]}, source="test")
    stage = PruneStage(config, Statistical())
    assert stage.raster_options(1, torch.zeros(3)).grad2d
    assert plan(stage)["collect gradient statistics"] == "range(0, 101)"
    assert list(plan(stage)) == ["update lr", "collect gradient statistics", "prune"]  # before it is asked


def test_pseudo_views_and_their_size(stages, toy):
    sampler = stages()[1].create_sampler(toy.scene, torch.Generator())
    assert (sampler.std, sampler.every) == (0.05, 3)
    assert stages(distill__pseudo_views=False)[1].create_sampler(toy.scene, torch.Generator()).every == 1


@pytest.mark.parametrize("preset", [*LightGaussian.PRESETS])
@pytest.mark.parametrize("rate", [*LightGaussian.RATES])
def test_every_preset_resolves_at_every_rate_point(preset, rate):
    config = resolve(LightGaussian, preset, rate).config
    assert config.prune.percent == LightGaussian.RATES[rate]["prune.percent"]
    shares = [values["prune.percent"] for values in LightGaussian.RATES.values()]
    assert shares == sorted(shares, reverse=True)  # r1 is the smallest file


def test_rate_points_differ_in_training_and_the_codec_does_not():
    hashes = {resolve(LightGaussian, "quick", rate).training_hash() for rate in LightGaussian.RATES}
    assert len(hashes) == 5
    plain = resolve(LightGaussian, "quick").training_hash()
    assert resolve(LightGaussian, "quick", sets={"codec.settings.ratio": 1.0}).training_hash() == plain


def test_the_plugin_declares_what_the_class_has(plugins):
    declared = plugins.methods.entry("lightgaussian").declared
    assert list(declared["presets"]) == list(LightGaussian.PRESETS)
    assert list(declared["rates"]) == list(LightGaussian.RATES)


@pytest.mark.parametrize(("asked", "restored"), [("restored", True), ("fresh", False)])
def test_pruning_goes_on_with_the_moments_of_the_3dgs_training(asked, restored):
    """As in the authors' code, which restores the optimizer from the checkpoint."""
    import copy

    from sw_gaussians.adam_moments import keep_moments

    config = LightGaussianConfig()
    config = config.model_copy(update={"prune": config.prune.model_copy(update={"optimizer": asked})})
    model = gaussians_from_points(PointCloud(torch.rand(20, 3), torch.rand(20, 3)), max_sh_degree=3)
    scene = SimpleNamespace(extent=1.0)
    trained = FineTuningStage(config, config.prune.lr).create_optimizer(model, scene)
    for parameter in model.parameters():
        parameter.grad = torch.rand_like(parameter)
    trained.step()
    keep_moments(model, trained)
    copied = copy.deepcopy(model)
    optimizer = PruneStage(config, Significance()).create_optimizer(copied, scene)
    assert (set(optimizer.states) == set(trained.states)) == restored
    for name, state in optimizer.states.items():
        assert state.step == 1
        assert torch.equal(state.tensors["exp_avg_sq"], trained.states[name].tensors["exp_avg_sq"])
    for group, rate in FineTuningStage(config, config.prune.lr).rates.of_step(0, 1.0).items():
        assert optimizer.lr(group) == rate  # step sizes are those of this stage


def test_a_scene_from_a_file_has_no_moments_to_go_on_with():
    model = gaussians_from_points(PointCloud(torch.rand(5, 3), torch.rand(5, 3)), max_sh_degree=3)
    stage = PruneStage(LightGaussianConfig(), Significance())
    assert stage.create_optimizer(model, SimpleNamespace(extent=1.0)).states == {}
