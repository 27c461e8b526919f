"""The method's page names every section, header value and scene, the README every preset and rate point."""

from pathlib import Path

import pytest

from sw_mesongs.presets import PRESETS, RATES
from sw_mesongs.published import SCENES, published

PAGE = Path(__file__).parents[3] / "docs" / "methods" / "mesongs.md"
README = Path(__file__).parents[1] / "README.md"
SECTIONS = ("box", "positions", "mean", "detail", "scales", "steps", "zeros", "index", "codebook")
HEADER = (
    "codec", "num_gaussians", "max_sh_degree", "active_sh_degree", "depth", "anchor", "bits", "blocks", "codebook_size",
)  # fmt: skip
alone = pytest.mark.skipif(not PAGE.is_file(), reason="the package stands alone, without the repository's docs")


@alone
def test_the_page_names_every_section_and_header_value_of_a_file(tmp_path):
    from splatwizard_core.coding.container import ContainerReader

    file = ContainerReader.open(PAGE.parents[2] / "tests" / "golden" / "mesongs_v1.swz")
    assert set(file.sections) == set(SECTIONS)
    assert set(file.static) == set(HEADER)
    text = PAGE.read_text()
    assert all(f"`{name}`" in text for name in (*SECTIONS, *HEADER))


@alone
@pytest.mark.parametrize(("family", "scene"), [(family, scene) for family in SCENES for scene in SCENES[family]])
def test_the_page_lists_the_values_of_every_scene(family, scene):
    c1, c2, c3 = (published(scene, family, point) for point in ("c1", "c2", "c3"))
    row = (
        f"| {family} | {scene} | {c1.depth} | {c1.codebook_size} | {c1.beta:g} | {c1.tau:g}, {c2.tau:g}, {c3.tau:g} "
        f"| {c1.blocks}, {c2.blocks}, {c3.blocks} | {c1.speed:g} |"
    )
    assert row in PAGE.read_text().splitlines()


def test_the_readme_names_every_preset_and_rate_point_with_its_configuration():
    lines = README.read_text().splitlines()
    assert all(any(f"`{name}`" in line for line in lines) for name in PRESETS)
    for name, values in RATES.items():
        row = next(line for line in lines if line.startswith(f"| `{name}`"))
        assert row.split("|")[2].strip() == values["authors.point"]
