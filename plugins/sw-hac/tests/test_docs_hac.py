"""The method's page names every setting and every section; the README every preset, rate point and departure."""

from pathlib import Path

import pytest
from hac_models import encoded, make

from splatwizard_core.coding.container import ContainerReader
from sw_hac.presets import PRESETS, RATES

ROOT = Path(__file__).parents[3]
PAGE = ROOT / "docs" / "methods" / "hac.md"
README = Path(__file__).parents[1] / "README.md"


@pytest.mark.skipif(not PAGE.is_file(), reason="the package stands alone, without the repository's docs")
def test_the_page_names_every_section_and_header_value():
    text = PAGE.read_text()
    reader = ContainerReader(encoded(make(n=20), codec__settings__mode="float"))
    for name in (*reader.sections, *reader.static):
        assert f"`{name}`" in text


def test_the_readme_names_every_preset_and_rate_point():
    text = README.read_text()
    assert all(f"`{name}`" in text for name in PRESETS)
    for name, values in RATES.items():
        row = next(line for line in text.splitlines() if line.startswith(f"| `{name}`"))
        assert f" {values['rate_term.weight']} " in row
