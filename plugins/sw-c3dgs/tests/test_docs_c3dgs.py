"""The method's page names every section and header value, the README every preset and rate point."""

from pathlib import Path

import pytest

from sw_c3dgs.coded import QUANTIZED
from sw_c3dgs.presets import PRESETS, RATES

PAGE = Path(__file__).parents[3] / "docs" / "methods" / "c3dgs.md"
README = Path(__file__).parents[1] / "README.md"
alone = pytest.mark.skipif(not PAGE.is_file(), reason="the package stands alone, without the repository's docs")


@alone
def test_the_page_names_every_section_and_header_value():
    text = PAGE.read_text()
    headers = ("codec", "num_gaussians", "num_colors", "num_shapes", "max_sh_degree", "arrays")
    for name in ("xyz", "color_index", "shape_index", "steps", "zeros", *QUANTIZED, *headers):
        assert f"`{name}`" in text


def test_the_readme_names_every_preset_and_rate_point_with_its_factors():
    lines = README.read_text().splitlines()
    assert all(any(f"`{name}`" in line for line in lines) for name in PRESETS)
    for name, values in RATES.items():
        row = next(line for line in lines if line.startswith(f"| `{name}`")).split("|")
        assert float(row[2]) == values["factors.thresholds"]
        assert float(row[3]) == values.get("factors.sizes", 1)
