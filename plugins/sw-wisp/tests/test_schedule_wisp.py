"""The plan that `sw schedule` prints."""

import pytest
from click.testing import CliRunner

from splatwizard_core.cli.main import cli


@pytest.mark.parametrize(("scene", "preset"), [("demo", "mcmc"), ("tandt/truck", "fast")])
def test_the_plan_names_the_preset_of_the_scene_that_it_starts_from(scene, preset):
    found = CliRunner().invoke(cli, ["schedule", "wisp", "--preset", "paper", "--scene", scene])
    assert f"starts from a trained 3dgs scene of preset {preset}\n" in found.output
