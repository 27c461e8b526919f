"""The README names every preset and rate point, with the share that goes in each round."""

from pathlib import Path

from sw_pup_3dgs.presets import PRESETS, RATES

README = Path(__file__).parents[1] / "README.md"


def test_the_readme_names_every_preset_and_rate_point_with_its_shares():
    text = README.read_text()
    assert all(f"`{name}`" in text for name in PRESETS)
    for name, values in RATES.items():
        row = next(line for line in text.splitlines() if line.startswith(f"| `{name}`"))
        (shares,) = values.values()
        assert ", ".join(f"{share:.3g}" for share in shares) in [cell.strip() for cell in row.split("|")]
