"""The plan of Compact3DGS is the published one, line by line, and so are its numbers."""

import pytest
from sw_compact3dgs.config import Compact3DGSConfig
from sw_compact3dgs.method import Compact3DGS
from sw_compact3dgs.stage import Compact3DGSStage

from splatwizard_core.errors import ConfigError
from splatwizard_core.plugins import load_plugins
from splatwizard_core.runs.config import apply_overrides, resolve
from splatwizard_core.training.params import PipelineParams
from splatwizard_core.training.scheduler import build_schedulers, format_plan

PAPER = """\
Pre   | update lr                   | range(30000)
Pre   | increase SH degree          | range(0, 30000, 1000)
Pre   | switch to RVQ training      | 29000
Post  | collect gradient statistics | range(15000)
Post  | prune and densify           | range(500, 15000, 100)
Post  | reset opacity               | range(0, 15000, 3000)
Post  | mask prune                  | range(15000, 30000, 1000)"""
"""The rows that the Splatwizard paper prints."""
ADDED = "Pre   | update network lr           | range(30000)"
"""The second optimizer of the authors has its own schedule, which is no row of the paper."""


def plan_of(stage):
    return build_schedulers(stage, PipelineParams())


def steps_of(stage, name: str) -> list[int]:
    pre, post = plan_of(stage)
    return [
        s for r in (*pre.registrations, *post.registrations) if r.name == name for s in r.fires_in(0, stage.iterations)
    ]


def test_the_plan_is_the_papers_rows_and_the_one_that_is_written_down_as_added():
    rows = format_plan(*plan_of(Compact3DGSStage(Compact3DGSConfig()))).splitlines()[2:]
    assert [row for row in rows if row != ADDED] == PAPER.splitlines()
    assert rows.count(ADDED) == 1


def test_the_steps_are_the_published_ones():
    stage = Compact3DGSStage(Compact3DGSConfig())
    assert steps_of(stage, "collect gradient statistics") == list(range(1, 15_000))
    assert steps_of(stage, "reset opacity") == [3000, 6000, 9000, 12_000]
    assert steps_of(stage, "mask prune") == list(range(15_000, 30_000, 1000))
    assert steps_of(stage, "switch to RVQ training") == [29_000]
    inria = Compact3DGSStage(resolve(Compact3DGS, "inria").config)
    assert steps_of(inria, "prune and densify")[0] == 600


def test_a_plan_scaled_to_a_tenth():
    stage = Compact3DGSStage(Compact3DGSConfig(iterations=3000, scale_schedule=True))
    assert steps_of(stage, "mask prune") == list(range(1500, 3000, 100))
    assert steps_of(stage, "switch to RVQ training") == [2900]
    assert stage.network_lr(500) == pytest.approx(0.01)
    assert stage.network_lr(501) == pytest.approx(0.0033)
    assert stage.network_lr(11) == pytest.approx(0.01)


def test_the_learning_rate_of_grid_and_network():
    stage = Compact3DGSStage(Compact3DGSConfig())
    expected = {1: 1e-4, 51: 0.00505, 101: 0.01, 5000: 0.01, 5001: 0.0033, 15_001: 0.001089, 30_000: 0.00035937}
    assert {step: stage.network_lr(step) for step in expected} == pytest.approx(expected)
    synthetic = Compact3DGSStage(resolve(Compact3DGS, "synthetic").config)
    assert synthetic.network_lr(25_000) == pytest.approx(1e-3)
    assert synthetic.network_lr(25_001) == pytest.approx(0.33e-3)


def test_the_published_hyper_parameters():
    real, synthetic = (resolve(Compact3DGS, preset, rate="r5").config for preset in ("paper", "synthetic"))
    for config, expected in ((real, (19, 5e-4, 0.01, 0.01)), (synthetic, (16, 4e-3, 1e-3, 1e-3))):
        assert (config.grid.log2_table, config.mask.weight, config.mask.lr, config.network.lr) == expected
        assert config.mask.factor == 1
    assert (real.rvq.size, real.rvq.stages, real.rvq.start, real.rvq.lr) == (64, 6, 29_000, 1e-4)
    assert (real.mask.threshold, real.mask.init, real.codec.settings.grid_threshold) == (0.01, 1.0, 0.1)
    assert real.codec.settings.grid_step == 0
    # Ours: a grid trained with a tenth of the step size is too small for the published threshold.
    assert (synthetic.codec.settings.grid_threshold, synthetic.codec.settings.grid_step) == (0, 0.06)
    lr = real.lr
    assert (lr.position_init, lr.position_final, lr.opacity, lr.scales, lr.quats) == (1.6e-4, 1.6e-6, 0.05, 5e-3, 1e-3)


@pytest.mark.parametrize(
    ("scene", "log2_size", "weight"),
    [("nerf_synthetic/lego", 16, 4e-3), ("dtu/scan24", 16, 4e-3), ("mipnerf360/room", 19, 5e-4)],
)
def test_scenes_known_to_be_synthetic_have_the_authors_values(scene, log2_size, weight):
    config = resolve(Compact3DGS, "paper", rate="r5", scene=scene, plugins=load_plugins()).config
    assert (config.grid.log2_table, config.mask.weight) == (log2_size, weight)


def test_rate_points_are_multiples_of_the_presets_weight():
    found = {}
    for rate in Compact3DGS.RATES:
        c = resolve(Compact3DGS, "paper", rate=rate).config
        settings = c.codec.settings
        found[rate] = (c.mask.weight * c.mask.factor, c.grid.log2_table, settings.pp, settings.grid_factor)
    assert found == {
        "r1": (4e-3, 17, True, 2), "r2": (2e-3, 19, True, 2), "r3": (1e-3, 19, True, 2), "r4": (5e-4, 19, True, 2),
        "r5": (5e-4, 19, True, 1), "r6": (2.5e-4, 19, True, 1), "r7": (5e-4, 19, False, 1),
    }  # fmt: skip
    entry = load_plugins().methods.entry("compact3dgs")
    assert list(entry.declared["presets"]) == list(Compact3DGS.PRESETS)
    assert list(entry.declared["rates"]) == list(Compact3DGS.RATES)


def test_post_processing_shares_its_training():
    assert len({resolve(Compact3DGS, "paper", rate=rate).training_hash() for rate in ("r4", "r5", "r7")}) == 1


def test_small_pictures_are_off_and_trainings_of_before_they_could_be_on_are_found():
    plain, small = (resolve(Compact3DGS, "paper", sets=sets).config for sets in ({}, {"pictures.schedule": "dash"}))
    assert "pictures" not in plain.identity()
    assert small.identity()["pictures"]["schedule"] == "dash"


def test_every_preset_ends_in_the_last_phase():
    for preset in Compact3DGS.PRESETS:
        config = resolve(Compact3DGS, preset).config
        stage = Compact3DGSStage(config)
        (switch,) = steps_of(stage, "switch to RVQ training")
        assert max(steps_of(stage, "prune and densify")) < min(steps_of(stage, "mask prune")) < switch
        assert switch < config.iterations


def test_what_has_no_effect_is_no_key():
    for key in ("mcmc.enabled", "sparse_adam", "lr.sh_dc", "sh_interval"):
        with pytest.raises(ConfigError, match="unknown key"):
            apply_overrides(Compact3DGSConfig(), {key: 1}, source="test")
