"""The method's page names every setting and every section."""

from pathlib import Path

import pytest

from sw_3dgs.presets import PRESETS, RATES
from sw_codecs.models.quantized import SECTIONS, Layout

ROOT = Path(__file__).parents[3]
PAGE = ROOT / "docs" / "methods" / "3dgs.md"
README = Path(__file__).parents[1] / "README.md"


@pytest.mark.skipif(not PAGE.is_file(), reason="the package stands alone, without the repository's docs")
def test_the_page_names_every_section_and_header_value():
    text = PAGE.read_text()
    for name in (*SECTIONS, "positions", "sh1", "sh2", "sh3", *Layout.model_fields, "mode"):
        assert f"`{name}`" in text


def test_the_readme_names_every_preset_and_rate_point_with_its_steps():
    text = README.read_text()
    assert all(f"`{name}`" in text for name in PRESETS)
    for name, values in RATES.items():
        row = next(line for line in text.splitlines() if line.startswith(f"| `{name}`"))
        if values["codec.name"] == "gaussians-quantized":
            steps = [v for k, v in values.items() if k != "codec.name"]
            assert [float(cell) for cell in row.split("|")[2:-1]] == steps
