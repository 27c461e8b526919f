"""The file in tiles: each prefix a scene, the base where nothing finer has come, the whole one the scene."""

import numpy as np
import pytest
import torch
from sw_gaussians.surfels import SurfelModel
from sw_lod import write_lod
from sw_lod.tiles import Tiles

from splatwizard_core.api import (
    BitstreamError,
    ContainerReader,
    ContainerWriter,
    GaussianModel,
    ShapeError,
    UserInputError,
)
from splatwizard_core.tooling import Prefix, load_plugins
from sw_codecs.models.codecs import Quantized


def encoded(model: GaussianModel, **settings) -> bytes:
    writer = ContainerWriter("m", 1)
    Tiles(load_plugins(), **settings).encode(model, writer)
    return writer.to_bytes()


def decoded(data: bytes, packets: int | None = None) -> GaussianModel:
    return Tiles(load_plugins()).decode(ContainerReader(data, "f.swz", Prefix(packets)))


@pytest.fixture(scope="module")
def data(model) -> bytes:
    return encoded(model, rows=400, layers=2, coarsest=10)


def table(model: GaussianModel) -> torch.Tensor:
    """All parameters, one row a Gaussian, in an order of their own."""
    raw = [getattr(model, name).detach().reshape(model.num_rows, -1) for name in sorted(model.RAW)]
    rows = torch.cat(raw, dim=1).numpy()
    return torch.from_numpy(rows[np.lexsort(rows.T)])


def test_the_whole_file_holds_what_one_without_packets_holds(data, model):
    writer = ContainerWriter("m", 1)
    Quantized(load_plugins()).encode(model, writer)
    plain = Quantized(load_plugins()).decode(ContainerReader(writer.to_bytes()))
    assert torch.equal(table(decoded(data)), table(plain))


def test_prefixes_grow_from_the_base(data):
    reader = ContainerReader(data)
    base, groups = reader.static["base"], reader.static["groups"]
    assert (len(base), len(groups), len(reader.cuts)) == (3, 6, 7)
    assert decoded(data, 1).num_rows == sum(base) == pytest.approx(120, abs=12)
    for packets in range(2, 8):
        there = groups[: packets - 1]
        begun = {tile for tile, _, _ in there}
        rest = sum(n for tile, n in enumerate(base) if tile not in begun)
        assert decoded(data, packets).num_rows == rest + sum(n for _, n, _ in there)


def test_a_tile_without_its_last_group_is_swollen(data, model):
    _, rows, swell = ContainerReader(data).static["groups"][0]
    assert swell > 0
    some = decoded(data, 2).log_scales[-rows:]
    whole = {tuple(row[:3]): row for row in torch.cat([decoded(data).means, decoded(data).log_scales], 1).tolist()}
    grown = [whole[tuple(place)][3:] for place in decoded(data, 2).means[-rows:].tolist()]
    assert torch.allclose(some, torch.tensor(grown) + swell, atol=1e-6)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_gaussians_come_back(model, count):
    few = GaussianModel(*(getattr(model, name).detach()[:count] for name in
                          ("means", "sh_dc", "sh_rest", "opacity_logits", "log_scales", "quats")))  # fmt: skip
    assert decoded(encoded(few)).num_rows == count


def test_surfels_are_refused(model):
    flat = SurfelModel(*(getattr(model, name).detach() for name in ("means", "sh_dc", "sh_rest", "opacity_logits")),
                       model.log_scales.detach()[:, :2], model.quats.detach())  # fmt: skip
    with pytest.raises(ShapeError, match="surfels"):
        encoded(flat)


@pytest.mark.parametrize(
    "change",
    [
        {"base": [1, 2]}, {"base": [2**32 - 1] * 256}, {"num_gaussians": 2**32 - 1}, {"primitive": "surfel"},
        {"groups": []}, {"groups": [[300, 1, 0.0]]}, {"packets": [[1200, 0.0]]}, {"base": -1},
    ],
)  # fmt: skip
def test_a_header_that_does_not_fit_is_refused(data, change):
    reader = ContainerReader(data)
    reader.static.update(change)
    with pytest.raises(BitstreamError):
        Tiles(load_plugins()).decode(reader)


def test_a_last_group_that_stays_swollen_is_refused(data):
    reader = ContainerReader(data)
    reader.static["groups"][-1][2] = 1.0
    with pytest.raises(BitstreamError, match="do not fit"):
        Tiles(load_plugins()).decode(reader)


def test_the_command_writes_it(model, tmp_path):
    record = write_lod(model, tmp_path / "x.swz", chunk=600, device="cpu")
    assert record["packets"][-1] == record["bytes"] == (tmp_path / "x.swz").stat().st_size
    assert len(record["packets"]) == 7
    with pytest.raises(UserInputError, match="--levels"):
        write_lod(model, tmp_path / "x.swz", levels=2)
