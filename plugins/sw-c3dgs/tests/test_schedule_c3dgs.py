"""The plan is the published one, and so are the step sizes, thresholds and codebooks."""

import pytest

from splatwizard_core.api import create_method
from splatwizard_core.errors import ConfigError
from splatwizard_core.runs.config import apply_overrides, resolve
from splatwizard_core.training.params import PipelineParams
from splatwizard_core.training.scheduler import build_schedulers, format_plan
from sw_c3dgs.config import C3DGSConfig
from sw_c3dgs.method import C3DGS

PLAN = """\
Stage | Task        | Plan
------+-------------+------------
Pre   | VQ compress | 1
Pre   | update lr   | range(5000)"""


def stage_of(plugins, **values):
    values = {key.replace("__", "."): value for key, value in values.items()}
    (stage,) = C3DGS(plugins, apply_overrides(C3DGSConfig(), values, source="test")).stages()
    return stage


def test_the_plan_is_the_published_table(plugins):
    stage = stage_of(plugins)
    assert format_plan(*build_schedulers(stage, PipelineParams())) == PLAN
    assert (stage.iterations, stage.starts_from, stage.name) == (5000, "3dgs", "finetune")


def test_the_step_sizes_are_those_at_the_end_of_3dgs(plugins):
    rates = stage_of(plugins).rates
    for step in (0, 1, 4999):
        assert rates.of_step(step, 2.0) == pytest.approx(
            {
                "means": 3.2e-6,
                "sh_dc": 0.0025,
                "sh_rest": 0.000125,
                "opacity_logits": 0.05,
                "shapes": 0.005,
                "log_factors": 0.005,
                "quats": 0.001,
            }
        )


def test_the_defaults_are_the_published_numbers():
    config = C3DGSConfig()
    color, shape = config.color, config.shape
    assert (color.size, color.threshold, color.iterations, color.batch) == (4096, 0.6e-6, 100, 2**18)
    assert (shape.size, shape.threshold, shape.iterations, shape.batch) == (4096, 0.3e-5, 800, 2**20)
    assert color.decay == shape.decay == 0.8
    assert color.training == shape.training == "batch-mean"
    assert (config.prune_threshold, config.lambda_dssim, config.iterations) == (0, 0.2, 5000)


def test_a_shorter_run_scales_the_plan_but_not_the_step_that_makes_codebooks(plugins):
    pre, _ = build_schedulers(stage_of(plugins, iterations=500, scale_schedule=True), PipelineParams())
    assert {r.name: str(r.when) for r in pre.registrations} == {"VQ compress": "1", "update lr": "range(0, 500)"}


@pytest.mark.parametrize("preset", [*C3DGS.PRESETS])
@pytest.mark.parametrize("rate", [*C3DGS.RATES])
def test_every_preset_resolves_at_every_rate_point_and_keeps_its_own_thresholds(preset, rate):
    config = resolve(C3DGS, preset, rate).config
    assert config.factors.thresholds == C3DGS.RATES[rate]["factors.thresholds"]
    assert config.color.threshold == (0.6e-4 if preset == "quick" else 0.6e-6)


def test_rate_points_ascend_and_the_published_one_is_the_default():
    points = [(-values["factors.thresholds"], values.get("factors.sizes", 1)) for values in C3DGS.RATES.values()]
    assert points == sorted(points)
    assert C3DGS.RATES[C3DGS.DEFAULT_RATE] == {"factors.thresholds": 1}


def test_rate_points_differ_in_training_and_the_codec_does_not():
    assert len({resolve(C3DGS, "quick", rate).training_hash() for rate in C3DGS.RATES}) == 5
    plain = resolve(C3DGS, "quick").training_hash()
    packed = resolve(C3DGS, "quick", sets={"codec.settings.arrays": "byte-planes"})
    assert packed.training_hash() == plain


def test_the_plugin_declares_what_the_class_has(plugins):
    declared = plugins.methods.entry("c3dgs").declared
    assert list(declared["presets"]) == list(C3DGS.PRESETS)
    assert list(declared["rates"]) == list(C3DGS.RATES)


def test_an_unknown_codec_is_told_before_anything_is_trained(plugins):
    with pytest.raises(ConfigError, match=r"no coder is called 'zip'; installed: .*gaussians-indexed"):
        stage_of(plugins, codec__name="zip")
    with pytest.raises(ConfigError, match="arrays"):
        create_method(plugins, "c3dgs", {"codec.settings.arrays": "zip"})
    assert create_method(plugins, "c3dgs", {"codec": "gaussians-exact"}).config.codec.settings == {}
