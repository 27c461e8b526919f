"""The README names every preset and rate point, with its level."""

from pathlib import Path

from sw_trimming_the_fat.presets import PRESETS, RATES

README = Path(__file__).parents[1] / "README.md"


def test_the_readme_names_every_preset_and_rate_point_with_its_level():
    text = README.read_text()
    assert all(f"`{name}`" in text for name in PRESETS)
    for name, values in RATES.items():
        row = next(line for line in text.splitlines() if line.startswith(f"| `{name}`"))
        (level,) = values.values()
        assert f"{level:g}" in [cell.strip() for cell in row.split("|")]
