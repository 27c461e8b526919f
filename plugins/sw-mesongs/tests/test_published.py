"""The authors' values by scene, family and configuration; presets and rate points that ask for them."""

from types import SimpleNamespace

import pytest

from splatwizard_core.runs.config import resolve
from sw_mesongs.method import MesonGS
from sw_mesongs.published import SCENES, Published, published

EVERY = [(family, scene) for family, table in SCENES.items() for scene in table]


def test_all_published_scenes_are_there():
    assert {family: len(table) for family, table in SCENES.items()} == {
        "nerf_synthetic": 8, "mipnerf360": 9, "tandt": 2, "db": 2,
    }  # fmt: skip


def test_values_at_c1():
    assert published("lego", "auto", "c1") == Published(14, 4096, 0.10, 0.05, 66, 1.6)
    assert published("kitchen", "mipnerf360", "c1") == Published(19, 8192, 0.14, 0.1, 66, 0.4)
    assert published("ficus", "auto", "c1").blocks == 50
    assert published("truck", "auto", "c1").tau == 0.38


@pytest.mark.parametrize(("family", "scene"), EVERY)
def test_the_other_configurations_follow_from_c1(family, scene):
    c1, c2, c3, toolkit = (published(scene, family, point) for point in ("c1", "c2", "c3", "tk-c1"))
    assert c1 == published(scene, "auto", "c1") == SCENES[family][scene]
    if scene not in ("flowers", "treehill"):
        assert c2.tau == c1.tau
    if scene not in ("flowers", "treehill", "drjohnson", "playroom", "truck"):
        assert c3.tau == pytest.approx(c1.tau + 0.1)
    assert c3.tau >= c1.tau
    assert c2.blocks < c3.blocks
    assert (toolkit.tau, toolkit.blocks) == (0.6, 80)
    for other in (c2, c3, toolkit):
        assert (other.depth, other.codebook_size, other.beta) == (c1.depth, c1.codebook_size, c1.beta)
    assert c2.speed == c3.speed == c1.speed >= toolkit.speed


def test_exceptions():
    assert published("flowers", "auto", "c2").tau == 0.45
    assert published("treehill", "auto", "c3").tau == 0.5
    assert published("playroom", "auto", "c3").tau == 0.2
    assert published("mic", "auto", "c2").blocks == 42
    assert published("ship", "auto", "tk-c1").speed == 0.1


def test_a_scene_that_nobody_knows_has_ours_and_the_grid_of_its_family():
    assert published("fox", "auto", "c1") == Published(20, 2048, 0.2, 0.1, 66, 0.4)
    assert published("fox", "nerf_synthetic", "c1").depth == 14
    assert published("lego", "mipnerf360", "c1") == Published()  # another scene of that name
    assert published("fox", "auto", "c3") == Published(tau=0.3, blocks=57)


def test_the_factor_is_applied_twice_below_one_as_in_the_authors_set_up():
    assert published("room", "auto", "c1").lr_factor == pytest.approx(0.16)
    assert published("chair", "auto", "c1").lr_factor == 1.6


def stage_of(plugins, scene, rate="r4", sets=None):
    """Return the stage once it has begun on a scene of that name."""
    (stage,) = MesonGS(plugins, resolve(MesonGS, "paper", rate, sets=sets or {}).config).stages()
    stage.values = stage.looked_up(SimpleNamespace(name=scene))
    return stage


def test_values_in_force_are_those_of_the_scene_where_the_configuration_leaves_them_open(plugins):
    stage = stage_of(plugins, "kitchen", "r2", {"codec.settings.blocks": 7, "prune.settings.beta": 0.3})
    assert stage.in_force() == {
        "prune.tau": 0.24, "prune.settings.beta": 0.3, "codec.settings.depth": 19, "codec.settings.blocks": 7,
        "codec.settings.codebook_size": 8192, "lr.factor": pytest.approx(0.16),
    }  # fmt: skip


def test_only_what_the_configuration_leaves_open_is_looked_up(plugins):
    stage = stage_of(plugins, "kitchen", "r2", {"codec.settings.blocks": 7, "prune.settings.beta": 0.3, "lr.factor": 0})
    assert stage.values == {"prune.tau": 0.24, "codec.settings.depth": 19, "codec.settings.codebook_size": 8192}
    assert list(stage.looked_up(None)) == list(stage.values)  # without a scene the keys are known


def test_a_pruner_without_beta_is_given_none(plugins):
    stage = stage_of(plugins, "kitchen", sets={"prune": "opacity"})
    assert list(stage.looked_up(None)) == list(stage.in_force()) == [
        "prune.tau", "codec.settings.depth", "codec.settings.blocks", "codec.settings.codebook_size", "lr.factor",
    ]  # fmt: skip


@pytest.mark.parametrize("preset", MesonGS.PRESETS)
@pytest.mark.parametrize("rate", MesonGS.RATES)
def test_every_preset_resolves_at_every_rate_point(preset, rate):
    config = resolve(MesonGS, preset, rate).config
    assert config.authors.point == MesonGS.RATES[rate]["authors.point"]
    assert preset in ("paper", "quick", config.authors.family)


def test_r1_is_the_smallest_file_and_the_default_is_c1():
    taus = [published("fox", "auto", values["authors.point"]).tau for values in MesonGS.RATES.values()]
    blocks = [published("fox", "auto", values["authors.point"]).blocks for values in MesonGS.RATES.values()]
    assert taus == sorted(taus, reverse=True)
    assert blocks[2] < blocks[3]
    assert MesonGS.RATES[MesonGS.DEFAULT_RATE] == {"authors.point": "c1"}


def test_the_plugin_declares_what_the_class_has(plugins):
    declared = plugins.methods.entry("mesongs").declared
    assert list(declared["presets"]) == list(MesonGS.PRESETS)
    assert list(declared["rates"]) == list(MesonGS.RATES)


def test_rate_points_and_settings_of_the_file_differ_in_training():
    hashes = {resolve(MesonGS, "quick", rate).training_hash() for rate in MesonGS.RATES}
    hashes.add(resolve(MesonGS, "quick", sets={"codec.settings.blocks": 7}).training_hash())
    assert len(hashes) == 5
