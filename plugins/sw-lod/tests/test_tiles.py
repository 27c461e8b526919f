"""The file in tiles: each prefix a scene, stand-ins for what has not come, the whole one the scene."""

import itertools

import numpy as np
import pytest
import torch
from sw_gaussians.made_up_cameras import plausible_cameras
from sw_gaussians.surfels import SurfelModel
from sw_lod import write_lod
from sw_lod.tiles import Tiles

from splatwizard_core.api import (
    BitstreamError,
    ContainerReader,
    ContainerWriter,
    GaussianModel,
    RasterOptions,
    ShapeError,
    UserInputError,
)
from splatwizard_core.tooling import NegotiatedRasterizer, Prefix, load_plugins
from sw_codecs.models.codecs import Quantized


def encoded(model: GaussianModel, **settings) -> bytes:
    writer = ContainerWriter("m", 1)
    Tiles(load_plugins(), **settings).encode(model, writer)
    return writer.to_bytes()


def decoded(data: bytes, packets: int | None = None) -> GaussianModel:
    return Tiles(load_plugins()).decode(ContainerReader(data, "f.swz", Prefix(packets)))


@pytest.fixture(scope="module")
def data(model) -> bytes:
    return encoded(model, rows=400, layers=2, coarsest=10, stand_ins=10)


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
    first, base, groups, finer = (reader.static[name] for name in ("first", "base", "groups", "finer"))
    assert (first, len(base), len(groups), len(finer), len(reader.cuts)) == (48, 3, 6, 7, 14)
    assert decoded(data, 1).num_rows == first + sum(base) == pytest.approx(168, abs=12)
    for packets in range(2, 8):
        there = groups[: packets - 1]
        stand_ins = dict(enumerate(base)) | {tile: m for tile, _, m in there}
        assert decoded(data, packets).num_rows == first + sum(n for _, n, _ in there) + sum(stand_ins.values())


@torch.no_grad()
def test_what_is_coarse_becomes_finer_packet_by_packet(data, model):
    """Within half of seven steps before, and exactly from the packet on that makes it finer."""
    reader = ContainerReader(data)
    first, groups = reader.static["first"], reader.static["groups"]
    ends = dict(enumerate(np.cumsum([first, *(n for _, n, _ in groups)]), 1))
    whole, step = decoded(data).opacity_logits, reader.static["opacity_step"]
    assert reader.static["finer"][0][0] == 8  # all Gaussians are there, none is as it will be
    coarse = torch.ones(len(whole), dtype=torch.bool)
    for packets in range(7, 15):
        if source := dict(reader.static["finer"]).get(packets):
            coarse[ends[source - 1] if source > 1 else 0 : ends[source]] = False
        some = decoded(data, packets).opacity_logits
        assert torch.equal(some[~coarse], whole[~coarse])
        assert float((some - whole).abs().max()) <= 3.001 * step
        assert not coarse.any() or float((some - whole)[coarse].abs().max()) > 2 * step
    assert not coarse.any()


def test_without_steps_in_between_what_stays_is_there_from_its_packet_on(model):
    data = encoded(model, rows=400, coarsest=10, stand_ins=10, times=1, raw=0)
    assert ContainerReader(data).static["finer"] == []
    places = [{tuple(row) for row in decoded(data, packets).means.tolist()} for packets in range(1, 8)]
    for less, more in itertools.pairwise(places):
        assert less & places[-1] <= more
    assert len(places[0] & places[-1]) >= 48


def test_stand_ins_look_alike_from_all_sides(data):
    rest = decoded(data, 1).sh_rest
    first = ContainerReader(data).static["first"]
    assert len(rest) > first + 100
    assert not rest[first:].any()
    assert rest[:first].any()


@torch.no_grad()
def test_more_of_a_file_is_nearer_to_the_whole(data):
    whole = decoded(data)
    rasterizer = NegotiatedRasterizer(load_plugins(), device=torch.device("cpu"), options={})
    cameras = plausible_cameras(whole, rasterizer, fit=1, held_out=3).held_out
    pictures = [
        [rasterizer.render(scene.gaussians(camera, rasterizer), camera, RasterOptions()).image for camera in cameras]
        for scene in (whole, *(decoded(data, packets) for packets in (1, 3, 5)))
    ]
    base, some, most = (
        sum(float((a - b).square().mean()) for a, b in zip(each, pictures[0], strict=True)) for each in pictures[1:]
    )
    assert base > 1.3 * some > 1.3 * 1.3 * most


def test_a_scene_that_no_camera_sees_is_ordered_all_the_same(model):
    faint = GaussianModel(**{name: getattr(model, name).detach().clone()[:30] for name in model.RAW})
    faint.requires_grad_(False)
    faint.opacity_logits.fill_(-5.4)
    faint.log_scales.fill_(-30)
    assert decoded(encoded(faint, rows=8)).num_rows == 30


@pytest.mark.parametrize("count", [0, 1])
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
        {"base": [1, 2]}, {"base": [2**32 - 1] * 255}, {"num_gaussians": 2**32 - 1}, {"primitive": "surfel"},
        {"groups": []}, {"groups": [[300, 1, 0]]}, {"packets": [[1200, 0.0]]}, {"base": -1}, {"first": 23},
        {"first": 2**32 - 1}, {"times": 2}, {"raw": 13}, {"raw": 18}, {"finer": []}, {"finer": [[1, 1]] * 7},
        {"finer": [[8, 9]] + [[packet, packet - 7] for packet in range(9, 15)]},
        {"finer": [[packet, 1] for packet in range(8, 15)]},
    ],
)  # fmt: skip
def test_a_header_that_does_not_fit_is_refused(data, change):
    reader = ContainerReader(data)
    reader.static.update(change)
    with pytest.raises(BitstreamError):
        Tiles(load_plugins()).decode(reader)


@pytest.mark.parametrize(
    ("section", "column", "value", "told"),
    [
        ("finer", 0, 32, "more than 5 bits"), ("finer", 2, -1, "more than 5 bits"), ("finer", 3, 4, "beyond 3"),
        ("opacity", 0, 2**30 // 7 + 1, "packet 1 is beyond"),
    ],
)  # fmt: skip
def test_values_that_no_coarse_row_lacks_are_refused(data, section, column, value, told):
    reader, columns = ContainerReader(data), load_plugins().entropy_models.load("columns")()
    rows, width = reader.static["first"], 10 + 3 * 3 + 3 if section == "finer" else 1
    changed = dict(reader.static["finer"])
    name = f"{next(packet for packet in changed if changed[packet] == 1)}/finer" if section == "finer" else "1/opacity"
    symbols = columns.decode(reader.section(name), (rows, width)).copy()
    symbols[5, column] = value
    writer, packet = ContainerWriter("m", 1), "1"
    writer.static.update(reader.static)
    for each in reader.sections:
        if each.partition("/")[0] != packet:
            writer.cut()
            packet = each.partition("/")[0]
        writer.add(each, columns.encode(symbols, None) if each == name else reader.section(each))
    writer.cut()
    with pytest.raises(BitstreamError, match=told):
        decoded(writer.to_bytes())


def test_a_last_group_with_stand_ins_is_refused(data):
    reader = ContainerReader(data)
    reader.static["groups"][-1][2] = 1
    with pytest.raises(BitstreamError, match="do not fit"):
        Tiles(load_plugins()).decode(reader)


def test_the_command_writes_it(model, tmp_path):
    record = write_lod(model, tmp_path / "x.swz", chunk=600, device="cpu")
    assert record["packets"][-1] == record["bytes"] == (tmp_path / "x.swz").stat().st_size
    assert len(record["packets"]) == 10
    with pytest.raises(UserInputError, match="--levels"):
        write_lod(model, tmp_path / "x.swz", levels=2)
