"""The method's page names every section and header value; the README every preset, rate point and row of the plan."""

from pathlib import Path

import pytest
from compact_models import encoded, make
from sw_compact3dgs.config import Compact3DGSConfig
from sw_compact3dgs.presets import PRESETS, RATES
from sw_compact3dgs.stage import Compact3DGSStage

from splatwizard_core.coding.container import ContainerReader
from splatwizard_core.training.params import PipelineParams
from splatwizard_core.training.scheduler import build_schedulers

ROOT = Path(__file__).parents[3]
PAGE = ROOT / "docs" / "methods" / "compact3dgs.md"
README = Path(__file__).parents[1] / "README.md"


@pytest.mark.skipif(not PAGE.is_file(), reason="the package stands alone, without the repository's docs")
def test_the_page_names_every_section_and_header_value():
    text = PAGE.read_text()
    reader = ContainerReader(encoded(make(n=20)))
    for name in (*reader.sections, *reader.static):
        assert f"`{name}`" in text


def test_the_readme_names_every_preset_rate_point_and_task():
    text = README.read_text()
    lines = text.splitlines()
    assert all(f"`{name}`" in text for name in PRESETS)
    for name, values in RATES.items():
        row = next(line for line in lines if line.startswith(f"| `{name}`"))
        assert f"| {values['mask.factor']:g} |" in row
        assert ("| no" in row) == (values.get("codec.settings.pp") is False)
    for scheduler in build_schedulers(Compact3DGSStage(Compact3DGSConfig()), PipelineParams()):
        for task in scheduler.registrations:
            assert any(f"| {task.name} |" in line for line in lines)
