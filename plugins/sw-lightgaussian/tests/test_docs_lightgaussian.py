"""The method's page names every setting and every section, the README every preset and rate point."""

from pathlib import Path
from typing import get_args

import pytest

from sw_lightgaussian.presets import PRESETS, RATES
from sw_lightgaussian.significance import Kind
from sw_lightgaussian.vectree import SECTIONS

PAGE = Path(__file__).parents[3] / "docs" / "methods" / "lightgaussian.md"
README = Path(__file__).parents[1] / "README.md"
alone = pytest.mark.skipif(not PAGE.is_file(), reason="the package stands alone, without the repository's docs")


@alone
def test_the_page_names_every_section_header_value_and_score():
    text = PAGE.read_text()
    headers = ("codec", "num_gaussians", "max_sh_degree", "active_sh_degree")
    for name in ("xyz", "attr", *SECTIONS.values(), *headers, *get_args(Kind)):
        assert f"`{name}`" in text


def test_the_readme_names_every_preset_and_rate_point_with_its_share():
    lines = README.read_text().splitlines()
    assert all(any(f"`{name}`" in line for line in lines) for name in PRESETS)
    for name, values in RATES.items():
        row = next(line for line in lines if line.startswith(f"| `{name}`"))
        assert float(row.split("|")[2]) == values["prune.percent"]
