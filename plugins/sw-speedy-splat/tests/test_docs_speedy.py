"""The method's page names every setting, the README every preset and rate point with its shares."""

from pathlib import Path

import pytest

from sw_speedy_splat.presets import PRESETS, RATES

PAGE = Path(__file__).parents[3] / "docs" / "methods" / "speedy-splat.md"
README = Path(__file__).parents[1] / "README.md"
alone = pytest.mark.skipif(not PAGE.is_file(), reason="the package stands alone, without the repository's docs")


def test_the_readme_names_every_preset_and_rate_point_with_its_shares():
    lines = README.read_text().splitlines()
    assert all(any(line.startswith(f"| `{name}`") for line in lines) for name in PRESETS)
    for name, values in RATES.items():
        row = next(line for line in lines if line.startswith(f"| `{name}`"))
        assert [float(cell) for cell in row.split("|")[2:4]] == list(values.values())
