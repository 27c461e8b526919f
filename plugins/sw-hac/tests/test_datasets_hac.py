"""The preset `paper` follows the data set of the scene: voxels, cells and background of the authors' scripts."""

import pytest
from click.testing import CliRunner
from hac_models import PLUGINS
from sw_anchors.params import RANDOM_START
from sw_datasets.families import BENCHMARKS
from sw_datasets.rules import rules_for

from splatwizard_core.cli.main import cli
from splatwizard_core.runs.config import resolve
from sw_hac.method import HAC


def resolved(scene, preset=None, **sets):
    return resolve(HAC, preset, sets=sets, scene=scene, plugins=PLUGINS)


@pytest.mark.parametrize(
    ("scene", "voxel", "factor"),
    [
        ("mipnerf360/garden", 0.001, 16), ("tandt/truck", 0.01, 16), ("db/playroom", 0.005, 16),
        ("bungee/rome", 0, 128), ("nerf_synthetic/lego", 0.001, 4), ("a/path/of/none", 0.001, 16),
    ],
)  # fmt: skip
def test_voxels_and_cells_follow_the_family(scene, voxel, factor):
    found = resolved(scene)
    assert (found.config.voxel_size, found.config.growth.init_factor) == (voxel, factor)


def test_synthetic_scenes_are_black_in_the_protocol_too():
    found = resolved("nerf_synthetic/lego")
    assert found.scene.init_points == 100_000
    family = BENCHMARKS["nerf_synthetic"]
    assert "/black/" in rules_for(family, "lego", found.scene).protocol().id
    assert (
        "/white/" in rules_for(family, "lego", resolved("nerf_synthetic/lego", background="white").scene).protocol().id
    )


@pytest.mark.parametrize("scene", ["nerf_synthetic/lego", "blender:a/folder"])
def test_the_opacity_network_waits_where_points_are_random(scene):
    random, given = resolved(scene).config, resolved("tandt/truck").config
    assert random.lr.mlp_opacity_early == RANDOM_START["lr.mlp_opacity_early"] < given.lr.mlp_opacity_early == 1
    assert random.visible_offsets > given.visible_offsets
    assert random.random_background_until == 1_500 > given.random_background_until == 0


def test_the_user_and_other_presets_come_first():
    found = resolved("tandt/truck", voxel_size=0.02)
    assert (found.config.voxel_size, found.provenance["voxel_size"]) == (0.02, "--set")
    assert resolved("tandt/truck").provenance["voxel_size"] == "data set 'tandt'"
    quick = resolved("tandt/truck", "quick")
    assert quick.config.voxel_size == HAC.PRESETS["quick"]["voxel_size"]
    assert resolved("tandt/truck", "paper").training_hash() != resolved("mipnerf360/garden", "paper").training_hash()


def test_the_plan_tells_what_the_data_set_decides():
    found = CliRunner().invoke(cli, ["schedule", "hac", "--scene", "tandt/truck"])
    assert found.exit_code == 0
    assert "hac, by data set: voxel_size = 0.01\n" in found.stderr
    assert "by data set" not in CliRunner().invoke(cli, ["schedule", "hac", "--scene", "mipnerf360/garden"]).output
