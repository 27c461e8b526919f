"""The method's page names every setting, section and header value, the README every preset and rate point."""

from pathlib import Path

import pytest

from sw_chimerags.file import GROUPS, POSITIONS
from sw_chimerags.presets import PRESETS, RATES

PAGE = Path(__file__).parents[3] / "docs" / "methods" / "chimerags.md"
README = Path(__file__).parents[1] / "README.md"
alone = pytest.mark.skipif(not PAGE.is_file(), reason="the package stands alone, without the repository's docs")


@alone
def test_the_page_names_every_section_and_header_value():
    text = PAGE.read_text()
    for group in GROUPS:
        assert all(f"`{group}/{section}`" in text for section in ("xyz", "box", "attributes", "vq/..."))
    headers = ("num_gaussians", "num_sh3", "max_sh_degree", "vq", "xyz", "prefer")
    assert all(f"`{name}`" in text for name in (*headers, *POSITIONS))


def test_the_readme_names_every_preset_and_rate_point_with_its_values():
    lines = README.read_text().splitlines()
    assert all(any(line.startswith(f"| `{name}`") for line in lines) for name in PRESETS)
    for name, values in RATES.items():
        row = next(line for line in lines if line.startswith(f"| `{name}`"))
        assert [float(cell) for cell in row.split("|")[2:5]] == list(values.values())
