"""The plan of HAC++ is that of HAC, a step earlier at its rate; what the authors set by data set is set."""

import pytest
from hac_plus_models import PLUGINS

from splatwizard_core.errors import ConfigError
from splatwizard_core.runs.config import resolve
from splatwizard_core.training.params import PipelineParams
from splatwizard_core.training.scheduler import build_schedulers, format_plan
from sw_hac_plus.config import HACPlusConfig
from sw_hac_plus.method import HACPlus
from sw_hac_plus.stage import HACPlusStage

PLAN = """\
Pre   | update lr                    | range(30000)
Pre   | update anchor bound          | 1
Post  | collect gradient statistics  | range(15000)
Post  | adjust anchor                | range(1500, 3000, 100)
Post  | adjust anchor                | range(4000, 15000, 100)
Post  | switch to quantized training | 3000
Post  | update anchor bound          | 10000
Post  | switch to entropy training   | 10000"""


def resolved(scene="mipnerf360/garden", preset="paper", rate=None, **sets):
    return resolve(HACPlus, preset, rate, sets=sets, scene=scene, plugins=PLUGINS)


def test_the_plan_is_the_published_one():
    stage = HACPlusStage(HACPlusConfig())
    assert format_plan(*build_schedulers(stage, PipelineParams())).splitlines()[2:] == PLAN.splitlines()


def test_rate_points_are_the_published_weights():
    weights = [values["rate_term.weight"] for values in HACPlus.RATES.values()]
    assert weights == [0.004, 0.003, 0.002, 0.001, 0.0005]
    entry = PLUGINS.methods.entry("hac-plus")
    assert list(entry.declared["presets"]) == list(HACPlus.PRESETS)
    assert list(entry.declared["rates"]) == list(HACPlus.RATES)


@pytest.mark.parametrize(
    ("scene", "voxel", "factor", "channel", "masks"),
    [
        ("mipnerf360/garden", 0.001, 16, "full", [1.5e-3, 1.5e-3, 1e-3, 5e-4, 2.5e-4]),
        ("tandt/truck", 0.01, 16, "full", [4e-4, 3e-4, 2e-4, 1e-4, 5e-5]),
        ("db/playroom", 0.005, 16, "full", [3.2e-4, 2.4e-4, 1.6e-4, 8e-5, 4e-5]),
        ("bungee/rome", 0, 128, "full", [4e-4, 3e-4, 2e-4, 1e-4, 5e-5]),
        ("nerf_synthetic/lego", 0.001, 4, "tiny", [3.2e-4, 2.4e-4, 1.6e-4, 8e-5, 4e-5]),
    ],
)
def test_values_by_data_set_are_the_authors(scene, voxel, factor, channel, masks):
    found = [resolved(scene, rate=rate) for rate in HACPlus.RATES]
    config = found[0].config
    assert (config.voxel_size, config.growth.init_factor, config.channel.kind) == (voxel, factor, channel)
    assert [HACPlusStage(each.config).masks_final for each in found] == pytest.approx(masks)
    assert found[0].scene.background == ("black" if scene.startswith("nerf") else None)


@pytest.mark.parametrize(("scene", "factor"), [("nerf_synthetic/lego", None), ("blender:a/folder", 0.1)])
def test_the_opacity_network_keeps_its_rate_on_nerf_synthetic(scene, factor):
    found = resolved(scene)
    assert (found.config.lr.mlp_opacity_early, found.config.random_background_until) == (factor, 1_500)
    assert found.scene.init_points == 100_000


def test_learning_rates_are_the_published_ones():
    stage = HACPlusStage(resolved(rate="r4").config)
    for step, channel, masks in ((0, 0.005, 0.01), (30_000, 5e-4, 5e-4)):
        rates = stage.learning_rates(step)
        assert (rates["channel"], rates["mask_logits"]) == pytest.approx((channel, masks))
    assert HACPlusStage(resolved(**{"lr.masks_final": 1e-4}).config).masks_final == 1e-4
    assert HACPlusStage(resolved(**{"rate_term.weight": 0}).config).learning_rates(30_000)["mask_logits"] > 0
    assert "channel" not in HACPlusStage(resolved(**{"channel.kind": "none"}).config).learning_rates(0)


def test_anchors_beside_the_lattice_are_refused():
    with pytest.raises(ConfigError, match=r"growth\.subvoxel"):
        resolved(**{"growth.subvoxel": True})


def test_every_preset_ends_in_the_entropy_phase():
    for preset in HACPlus.PRESETS:
        config = resolved(preset=preset).config
        assert config.phases.quantized < config.phases.entropy < config.iterations
        assert sum(config.channel.slices) == config.feature_dim
