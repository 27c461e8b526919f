"""The files of 3DGS under other methods' names: chosen by name, checked on the way back."""

import pytest
import torch

from splatwizard_core.coding.container import ContainerReader, ContainerWriter
from splatwizard_core.coding.gaussian_codec import decode_gaussians, encode_gaussians, gaussian_codecs
from splatwizard_core.errors import BitstreamError, ConfigError
from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.plugins import load_plugins


@pytest.fixture(scope="module")
def plugins():
    return load_plugins()


@pytest.fixture(scope="module")
def model():
    g = torch.Generator().manual_seed(3)
    n = 500
    return GaussianModel(
        torch.randn(n, 3, generator=g), torch.randn(n, 1, 3, generator=g), 0.1 * torch.randn(n, 15, 3, generator=g),
        torch.randn(n, generator=g), torch.randn(n, 3, generator=g) - 3, torch.randn(n, 4, generator=g),
    )  # fmt: skip


def written(plugins, name, model, **settings):
    writer = ContainerWriter("some-method", 1)
    encode_gaussians(plugins, name, model, writer, **settings)
    return writer


def test_each_codec_that_says_it_codes_gaussians_decodes_what_it_encodes(plugins, model):
    assert {"gaussians-exact", "gaussians-quantized"} <= set(gaussian_codecs(plugins))
    for name in gaussian_codecs(plugins):
        reader = ContainerReader(written(plugins, name, model).to_bytes(), "file.swz")
        decoded = decode_gaussians(plugins, reader)
        assert isinstance(decoded, GaussianModel)
        assert 0 < decoded.num_rows <= model.num_rows
        for parameter in decoded.parameters():
            assert bool(torch.isfinite(parameter).all())


def test_exact_is_bit_for_bit(plugins, model):
    data = written(plugins, "gaussians-exact", model).to_bytes()
    decoded = decode_gaussians(plugins, ContainerReader(data, "file.swz"))
    for (name, a), (_, b) in zip(model.named_parameters(), decoded.named_parameters(), strict=True):
        assert torch.equal(a, b), name


def test_settings_reach_the_codec(plugins, model):
    coarse = written(plugins, "gaussians-quantized", model, dc_step=0.2, rest_step=0.2).to_bytes()
    fine = written(plugins, "gaussians-quantized", model).to_bytes()
    assert len(coarse) < 0.8 * len(fine)


def test_an_unknown_codec_is_an_error_that_names_those_there_are(plugins, model):
    with pytest.raises(ConfigError, match="gaussians-exact"):
        written(plugins, "range", model)  # a coder, but not one of Gaussians


@pytest.mark.parametrize("claimed", ["range", "huffman", "x" * 500, 7, None])
def test_a_file_may_name_only_codecs_of_gaussians(plugins, model, claimed):
    writer = written(plugins, "gaussians-exact", model)
    writer.static["codec"] = claimed
    with pytest.raises(BitstreamError, match="codec"):
        decode_gaussians(plugins, ContainerReader(writer.to_bytes(), "file.swz"))
