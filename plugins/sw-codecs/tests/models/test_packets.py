"""The quantised file in packets of Gaussians: each prefix a scene, the most significant first, exact to the bit."""

import math

import pytest
import torch
from sw_gaussians.surfels import SurfelModel

from splatwizard_core.coding.container import ContainerReader, ContainerWriter
from splatwizard_core.coding.cuts import Prefix
from splatwizard_core.errors import BitstreamError, ConfigError
from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.plugins import load_plugins
from sw_codecs.models.codecs import Quantized

N = 400


def gaussians(n: int = N) -> GaussianModel:
    g = torch.Generator().manual_seed(4)
    return GaussianModel(
        torch.randn(n, 3, generator=g), torch.randn(n, 1, 3, generator=g), 0.1 * torch.randn(n, 3, 3, generator=g),
        2 * torch.randn(n, generator=g), torch.randn(n, 3, generator=g) - 3, torch.randn(n, 4, generator=g),
    )  # fmt: skip


def encoded(model: GaussianModel, **settings) -> bytes:
    writer = ContainerWriter("m", 1)
    Quantized(load_plugins(), **settings).encode(model, writer)
    return writer.to_bytes()


def decoded(data: bytes, prefix: Prefix = Prefix()) -> GaussianModel:  # noqa: B008 (a frozen value)
    return Quantized(load_plugins()).decode(ContainerReader(data, "f.swz", prefix))


@pytest.fixture(scope="module")
def data() -> bytes:
    return encoded(gaussians(), prefixes=8)


def rows(model: GaussianModel) -> torch.Tensor:
    """All parameters but scales, one row a Gaussian, in an order of their own."""
    table = torch.cat(
        [p.detach().flatten(1) for name, p in model.named_parameters() if p.ndim > 1 and name != "log_scales"], 1
    )
    return table[table[:, 0].argsort()]


def test_no_prefixes_give_the_file_without_them():
    assert encoded(gaussians(), prefixes=0) == encoded(gaussians())
    assert ContainerReader(encoded(gaussians())).cuts == []


def test_eight_prefixes_are_exact(data):
    reader = ContainerReader(data)
    ends = [cut["bytes"] for cut in reader.summary()["cuts"]]
    assert (len(ends), ends[-1]) == (8, len(data))
    counts = []
    for packets, end in enumerate(ends, 1):
        short = decoded(data[:end])
        assert short.digest() == decoded(data, Prefix(packets)).digest()
        counts.append(short.num_rows)
    assert counts == [round(short.num_rows * 16 ** (k / 8 - 1)) for k in range(1, 9)]


def test_the_whole_file_holds_what_one_without_packets_holds(data):
    whole, plain = decoded(data), decoded(encoded(gaussians()))
    assert torch.equal(rows(whole), rows(plain))
    assert torch.equal(whole.log_scales.sort(0).values, plain.log_scales.sort(0).values)


def test_what_covers_most_comes_first_and_swells_to_what_all_cover(data):
    def covered(model):
        two = model.log_scales.double().sort(descending=True).values[:, :2]
        return torch.sigmoid(model.opacity_logits.double()) * two.sum(1).exp()

    whole = covered(decoded(data)).detach()
    for packets in range(1, 9):
        model = decoded(data, Prefix(packets))
        found = covered(model).detach()
        grown = found.sum() / whole[: len(found)].sum()
        assert math.isclose(found.sum(), whole.sum(), rel_tol=1e-3)  # the header has four digits
        # Sizes are those of the file but for what they have grown by; those left out cover less.
        assert packets == 8 or whole[len(found) :].max() <= (found / grown).min() * 1.0001


@pytest.mark.parametrize("n", [0, 1, 3])
def test_few_gaussians_leave_packets_empty(n):
    data = encoded(gaussians(n), prefixes=8, positions="octree")
    models = [decoded(data, Prefix(packets)) for packets in range(1, 9)]
    found = [model.num_rows for model in models]
    assert found == sorted(found)
    assert found[-1] == decoded(encoded(gaussians(n))).num_rows


def test_surfels_come_in_packets_too():
    model = gaussians()
    tensors = {name: each.detach() for name, each in model.named_parameters()}
    tensors["log_scales"] = tensors["log_scales"][:, :2].contiguous()
    data = encoded(SurfelModel(**tensors), prefixes=3)
    first = decoded(data, Prefix(1))
    assert isinstance(first, SurfelModel)
    assert 0 < first.num_rows < decoded(data).num_rows


@pytest.mark.parametrize(
    "packets",
    [
        [], [[400, 0]], [[1, 0]] * 8, [[2**33, 0]] * 8, [[-1, 0]] * 8, [[50, -1]] * 8, [[50, 11]] * 8, [[50]] * 8, 8,
        [[50, "a"]] * 8, [[50, 0]] * 9, None,
    ],
)  # fmt: skip
def test_packets_that_do_not_fit_the_file_are_refused(data, packets):
    reader = ContainerReader(data, "f.swz")
    reader.static["packets"] = packets
    with pytest.raises(BitstreamError, match=r"f\.swz: "):
        Quantized(load_plugins()).decode(reader)


def test_a_packet_that_is_damaged_is_named(data):
    reader = ContainerReader(data, "f.swz")
    reader._payload["3/scales"] = reader._payload["2/scales"]
    with pytest.raises(BitstreamError, match="section '3/scales'"):
        Quantized(load_plugins()).decode(reader)


@pytest.mark.parametrize("prefixes", [-1, 65, "many"])
def test_numbers_of_packets_have_bounds(prefixes):
    with pytest.raises((ConfigError, ValueError), match="prefixes"):
        Quantized(load_plugins(), prefixes=prefixes)
