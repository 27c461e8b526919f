"""The method's page names every header value and data set, the README every preset and rate point."""

from pathlib import Path

import pytest

from sw_2dgs.datasets import FAMILIES, OTHER
from sw_2dgs.presets import PRESETS, RATES

PAGE = Path(__file__).parents[3] / "docs" / "methods" / "2dgs.md"
README = Path(__file__).parents[1] / "README.md"
alone = pytest.mark.skipif(not PAGE.is_file(), reason="the package stands alone, without the repository's docs")


@alone
def test_the_page_names_what_the_header_of_a_file_adds():
    assert all(f"`{name}`" in PAGE.read_text() for name in ("primitive", "depth_ratio", "lambda_dist", "lambda_normal"))


@alone
def test_the_page_lists_the_values_of_every_data_set():
    lines = PAGE.read_text().splitlines()
    for name, surface in {**FAMILIES, "any other": OTHER}.items():
        (line,) = (each for each in lines if each.startswith((f"| `{name}` |", f"| {name} |")))
        ratio, dist, normal = (cell.split() for cell in line.split("|")[2:5])
        assert [float(cell[0]) for cell in (ratio, dist, normal)] == list(vars(surface).values())


def test_the_readme_names_every_preset_and_rate_point():
    text = README.read_text()
    assert all(f"`{name}`" in text for name in (*PRESETS, *RATES))
