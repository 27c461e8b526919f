"""The file holds what was trained, by any codec of Gaussians; the pages name every setting."""

from pathlib import Path

import pytest
import torch

from splatwizard_core.coding.container import ContainerReader, ContainerWriter
from splatwizard_core.coding.gaussian_codec import gaussian_codecs
from splatwizard_core.errors import BitstreamError, ConfigError
from splatwizard_core.experiments.config import apply_overrides
from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.plugins import load_plugins
from sw_trimming_the_fat.config import TrimmingTheFatConfig
from sw_trimming_the_fat.method import TrimmingTheFat
from sw_trimming_the_fat.presets import PRESETS, RATES

PAGE = Path(__file__).parents[3] / "docs" / "methods" / "trimming-the-fat.md"
README = Path(__file__).parents[1] / "README.md"


def model_of(n=60):
    g = torch.Generator().manual_seed(3)

    def normal(*shape):
        return torch.randn(*shape, generator=g)

    return GaussianModel(
        normal(n, 3), normal(n, 1, 3), normal(n, 15, 3) / 10, normal(n), normal(n, 3) - 3, normal(n, 4)
    )


def written(model, **values) -> ContainerReader:
    method = TrimmingTheFat(load_plugins(), apply_overrides(TrimmingTheFatConfig(), values, source="test"))
    writer = ContainerWriter(method.name, method.version)
    method.encode(model, writer)
    return ContainerReader(writer.to_bytes(), "file.swz")


def decoded(reader):
    return TrimmingTheFat(load_plugins(), None).decode(reader)


def test_by_default_every_bit_comes_back_at_236_bytes_a_gaussian():
    model = model_of()
    reader = written(model)
    found = decoded(reader)
    for (name, a), (_, b) in zip(model.named_parameters(), found.named_parameters(), strict=True):
        assert torch.equal(a, b), name
    assert found.active_sh_degree == 3
    arrays = sum(2 + 4 * getattr(model, name).dim() for name in dict(model.named_parameters()))  # dtype and shape
    assert reader.size == reader.header_bytes + arrays + 236 * 60


@pytest.mark.parametrize(
    "codec",
    [
        "gaussians-exact",
        "gaussians-ply",
        "gaussians-zstd",
        "gaussians-quantized",
        pytest.param("vectree", marks=pytest.mark.slow),  # trains a codebook
    ],
)
def test_every_codec_of_gaussians_serves(codec):
    if codec not in gaussian_codecs(load_plugins()):
        pytest.skip(f"codec {codec} is not installed")
    reader = written(model_of(), codec=codec)
    assert reader.static["codec"] == codec
    assert 0 < decoded(reader).num_rows <= 60


def test_an_unknown_codec_and_another_layout_are_refused():
    with pytest.raises(ConfigError, match="gaussians-exact"):
        written(model_of(), codec="zip")
    reader = written(model_of())
    reader.version = 7
    with pytest.raises(BitstreamError, match=r"version 7.*upgrade sw-trimming-the-fat"):
        decoded(reader)
    with pytest.raises(TypeError, match="GaussianModel"):
        written(torch.nn.Linear(1, 1))


def test_an_unknown_codec_is_told_before_anything_is_trained():
    config = apply_overrides(TrimmingTheFatConfig(), {"codec": "zip"}, source="test")
    with pytest.raises(ConfigError, match="gaussians-exact"):
        TrimmingTheFat(load_plugins(), config).stages()


def test_the_registry_and_the_readme_name_every_preset_and_rate_point():
    entry = next(e for e in load_plugins().methods if e.name == TrimmingTheFat.name)
    assert entry.declared["presets"] == [*PRESETS]
    assert entry.declared["rates"] == [*RATES]
    text = README.read_text()
    assert all(f"`{name}`" in text for name in PRESETS)
    for name, values in RATES.items():
        row = next(line for line in text.splitlines() if line.startswith(f"| `{name}`"))
        (value,) = values.values()
        cells = [cell.strip() for cell in row.split("|")]
        assert f"{value:g}" in cells
