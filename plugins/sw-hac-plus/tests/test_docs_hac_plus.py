"""The method's page names every section and header value; the README every preset, rate point and row of the plan."""

from pathlib import Path

import pytest
from hac_plus_models import encoded, make

from splatwizard_core.coding.container import ContainerReader
from splatwizard_core.training.params import PipelineParams
from splatwizard_core.training.scheduler import build_schedulers, format_plan
from sw_hac_plus.config import HACPlusConfig
from sw_hac_plus.presets import BY_DATASET, PRESETS, RATES
from sw_hac_plus.stage import HACPlusStage

PAGE = Path(__file__).parents[3] / "docs" / "methods" / "hac-plus.md"
README = (Path(__file__).parents[1] / "README.md").read_text()


@pytest.mark.skipif(not PAGE.is_file(), reason="the package stands alone, without the repository's docs")
def test_the_page_names_every_section_and_header_value_and_the_values_by_data_set():
    text = PAGE.read_text()
    reader = ContainerReader(encoded(make(n=20), codec__settings__mode="float"))
    for name in (*reader.sections, *reader.static):
        assert f"`{name}`" in text
    for family, values in BY_DATASET.items():
        row = next(line for line in text.splitlines() if line.startswith(f"| `{family}`"))
        for key, value in values.items():
            assert (key == "voxel_size" and value == 0) or str(value).lower() in row


def test_the_readme_names_every_preset_and_rate_point():
    assert all(f"`{name}`" in README for name in (*PRESETS, *BY_DATASET))
    for name, values in RATES.items():
        row = next(line for line in README.splitlines() if line.startswith(f"| `{name}`"))
        assert f" {values['rate_term.weight']} " in row


def test_the_readme_has_the_plan():
    rows = format_plan(*build_schedulers(HACPlusStage(HACPlusConfig()), PipelineParams())).splitlines()[2:]
    for row in rows:
        stage, task, plan = (part.strip() for part in row.split("|"))
        assert f"| {stage} | {task} | `{plan}` |" in README
