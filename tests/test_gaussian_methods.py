"""Methods that leave their file to a codec of Gaussians: by default it is exact, and every codec serves each."""

import pytest
import torch
from sw_gaussians.method import GaussianMethod

from splatwizard_core.coding.container import ContainerReader, ContainerWriter
from splatwizard_core.errors import BitstreamError, ConfigError
from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.plugins import load_plugins
from splatwizard_core.plugins.catalogue import is_ours
from splatwizard_core.runs.config import apply_overrides

PLUGINS = load_plugins()
METHODS = [e.name for e in PLUGINS.methods if is_ours(e.distribution) and issubclass(e.load(), GaussianMethod)]
EXACT = [name for name in METHODS if PLUGINS.methods.load(name).Config().codec.name == "gaussians-exact"]
CODECS = [name for name in PLUGINS.gaussian_codecs.names if is_ours(PLUGINS.coders.entry(name).distribution)]
IN_TURN = {(name, CODECS[i % len(CODECS)]) for i, name in enumerate(METHODS)}
PAIRS = sorted(IN_TURN | {(name, codec) for name in ("3dgs", "2dgs") for codec in CODECS})
"""Every codec for Gaussians and for surfels, and every method with one of them: all share one `encode`."""
QUICK = {
    "vectree": {"codec.settings.iterations": 5, "codec.settings.batch": 100},
    "raht": {"codec.settings.vq_steps": 5},
}
"""Settings with which a codec that trains a codebook takes no seconds."""


def model_of(n=60):
    g = torch.Generator().manual_seed(3)

    def normal(*shape):
        return torch.randn(*shape, generator=g)

    return GaussianModel(
        normal(n, 3), normal(n, 1, 3), normal(n, 15, 3) / 10, normal(n), normal(n, 3) - 3, normal(n, 4)
    )


def written(name, model, **values) -> ContainerReader:
    cls = PLUGINS.methods.load(name)
    method = cls(PLUGINS, apply_overrides(cls.Config(), values, source="test"))
    writer = ContainerWriter(method.name, method.version)
    method.encode(model, writer)
    return ContainerReader(writer.to_bytes(), "file.swz")


def decoded(name, reader):
    return PLUGINS.methods.load(name)(PLUGINS, None).decode(reader)


def test_the_methods_that_only_prune_are_among_them():
    assert {"trimming-the-fat", "pup-3dgs", "speedy-splat"} <= set(METHODS)


@pytest.mark.parametrize("name", EXACT)
def test_by_default_every_bit_comes_back_at_236_bytes_a_gaussian(name):
    model = model_of()
    reader = written(name, model)
    found = decoded(name, reader)
    for (tensor, a), (_, b) in zip(model.named_parameters(), found.named_parameters(), strict=True):
        assert torch.equal(a, b), tensor
    assert found.active_sh_degree == 3
    arrays = sum(2 + 4 * getattr(model, tensor).dim() for tensor in dict(model.named_parameters()))  # dtype and shape
    assert reader.size == reader.header_bytes + arrays + 236 * 60


@pytest.mark.parametrize(("name", "codec"), PAIRS)
def test_every_codec_of_gaussians_serves(name, codec):
    reader = written(name, model_of(), **{"codec.name": codec}, **QUICK.get(codec, {}))
    written_by = getattr(PLUGINS.gaussian_codecs.load(codec), "WRITES", codec)
    assert PLUGINS.methods.load(name)(PLUGINS, None).codec_of(reader) == written_by
    assert 0 < decoded(name, reader).num_rows <= 60


@pytest.mark.parametrize("name", METHODS)
def test_an_unknown_codec_and_another_layout_are_refused(name):
    with pytest.raises(ConfigError, match="gaussians-exact"):
        written(name, model_of(), codec="zip")
    reader = written(name, model_of())
    reader.version = 7
    with pytest.raises(BitstreamError, match=rf"{name} layout version 7 is unknown, this installation reads"):
        decoded(name, reader)
