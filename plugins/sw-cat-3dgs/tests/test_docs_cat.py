"""The method's page names every setting and every section; the README every preset, rate point and step of the plan."""

from pathlib import Path

import pytest

from splatwizard_core.plugins import load_plugins
from splatwizard_core.training.params import PipelineParams
from splatwizard_core.training.scheduler import build_schedulers
from sw_cat_3dgs.codec import sections
from sw_cat_3dgs.config import CatConfig
from sw_cat_3dgs.method import Cat3DGS
from sw_cat_3dgs.presets import PRESETS, RATES
from sw_cat_3dgs.stage import CatStage

PAGE = Path(__file__).parents[3] / "docs" / "methods" / "cat-3dgs.md"
README = Path(__file__).parents[1] / "README.md"


@pytest.mark.skipif(not PAGE.is_file(), reason="the package stands alone, without the repository's docs")
def test_the_page_names_every_section():
    text = PAGE.read_text()
    shape = Cat3DGS(load_plugins(), CatConfig()).shape()
    for name in ("anchors", "masks", "networks", "frame", "triplane", *sections(shape)):
        assert f"`{name}`" in text


def test_the_readme_has_the_plan_the_presets_and_the_rate_points():
    text = README.read_text()
    pre, post = build_schedulers(CatStage(CatConfig()), PipelineParams())
    for stage, scheduler in (("Pre", pre), ("Post", post)):
        for entry in scheduler.registrations:
            when = str(entry.when).replace("range(0, 40000)", "range(40000)").replace("range(0, 15000)", "range(15000)")
            assert f"| {stage} | {entry.name} | `{when}` |" in text
    assert all(f"`{name}`" in text for name in PRESETS)
    for name, values in RATES.items():
        row = next(line for line in text.splitlines() if line.startswith(f"| `{name}`"))
        assert f"| {values['rate_term.lambda_']} |" in row
