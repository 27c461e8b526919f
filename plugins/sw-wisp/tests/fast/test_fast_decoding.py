"""Compiled kernels read and predict as the plain code does, damage included."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from test_context import some_networks
from wisp_scenes import made_up

from splatwizard_core.api import BitstreamError, ContainerReader, ContainerWriter
from sw_codecs.exact_native import EXACT as CODECS
from sw_codecs.fast import exact_face as codecs_face
from sw_wisp import file, nested, octree, packets
from sw_wisp.fast import axes, exact_face, forecasts, running_means, streams, ties
from sw_wisp.fast.exact_native import EXACT
from sw_wisp.fast.running_means import pyramid_of
from sw_wisp.fast.streams import FastReader
from sw_wisp.nested import Reader, Writer
from sw_wisp.numbers import BLOCKS, PARTS
from sw_wisp.octree_contexts import Shares
from sw_wisp.pyramid import BASE, REFINED, VIEW
from sw_wisp.shape import log_covariance, numbers_of, scales_and_quats

MODULES = (CODECS, EXACT)
pytestmark = pytest.mark.skipif(
    any(module.available() is not None for module in MODULES), reason=str([module.available() for module in MODULES])
)


def written(scene) -> bytes:
    writer = ContainerWriter("wisp", 1)
    file.encode(scene, writer)
    return writer.to_bytes()


@pytest.fixture
def plain(monkeypatch):
    """Calls a function as if there were no kernels."""

    def call(work):
        with monkeypatch.context() as patch:
            for module in (streams, running_means, ties, forecasts, axes):
                patch.setattr(module, "EXACT", SimpleNamespace(try_load=lambda: False))
            return work()

    return call


@pytest.mark.parametrize(("subsets", "planes"), [(1, 0), (3, 1), (2, 2)])
def test_files_decode_to_the_same(plain, subsets, planes):
    scene = replace(made_up(900, subsets=subsets, planes=planes), context=some_networks().exact())
    data = written(scene)
    assert file.decode(ContainerReader(data)).digest() == plain(lambda: file.decode(ContainerReader(data)).digest())


def test_one_stream_of_all_kinds_of_symbols():
    rng = np.random.default_rng(0)
    ones, tables = rng.integers(1, 4096, 700), rng.integers(0, 64, 5000).astype(np.uint8)
    bits = rng.random(700) < ones / 4096
    indices = np.rint(rng.normal(0, 3, 5000)).astype(np.int64)
    indices[::900] = rng.integers(-(10**5), 10**5, 6)  # escapes
    coarse = nested.coarser(indices)
    writer = Writer()
    writer.bits(ones, bits)
    writer.indices(tables, coarse)
    writer.trits(tables, coarse, indices - 3 * coarse)
    writer.bits(ones, ~bits)
    reader = FastReader(writer.finish())
    assert np.array_equal(reader.bits(ones, None), bits)
    assert np.array_equal(reader.indices(tables, None), coarse)
    assert np.array_equal(reader.trits(tables, coarse, None), indices - 3 * coarse)
    assert np.array_equal(reader.bits(ones, None), ~bits)
    reader.finish()


def told(reader_class, data: bytes, ones: np.ndarray) -> object:
    """Answer of a reader to bits: them, or that they are damaged, or too few."""
    try:
        reader = reader_class(data)
        found = reader.bits(ones, None).tolist()
    except BitstreamError:
        return "damaged"
    try:
        reader.finish()
    except BitstreamError:
        return "left", found
    return found


def test_damaged_streams_are_told_alike():
    rng = np.random.default_rng(1)
    kinds = set()
    for _ in range(300):
        ones = rng.integers(1, 4096, rng.integers(1, 80))
        writer = Writer()
        writer.bits(ones, rng.random(len(ones)) < ones / 4096)
        data = writer.finish()
        for changed in (data, data[:-4], data + bytes(4), data + rng.bytes(8), rng.bytes(len(data)), b""):
            one, other = told(Reader, changed, ones), told(FastReader, changed, ones)
            assert one == other
            kinds.add(one if one == "damaged" else type(one))
    assert kinds == {"damaged", tuple, list}


def cells_of(reader_class, data: bytes, shares: Shares, rows: int, earlier: octree.Cells) -> object:
    try:
        found = octree.code_cells(reader_class(data), shares, rows, earlier, None)
    except BitstreamError as error:
        return str(error) if "announced" in str(error) else "damaged"
    return found.levels.tolist(), found.codes.tolist()


@pytest.mark.parametrize("levels", [[3], [5, 6, 7], [16, 17, 18], [18]])
def test_octrees_of_subsets_are_read_alike(levels):
    rng = np.random.default_rng(2)
    level = rng.choice(levels, 600)
    codes = rng.integers(0, 8**18, 600) & ~((1 << 30) - 1) | rng.integers(0, 1 << 12, 600)
    level = octree.spread_crowds(level, codes, rng.random(600))
    cells = octree.Cells(level, codes >> 3 * (18 - level))
    order = np.lexsort((cells.levels, cells.finest))
    label = rng.random(600) < 0.4
    parts = [cells.part(order[label[order] == each]) for each in (False, True)]
    shares = octree.fit_shares(parts)
    for number, part in enumerate(parts):
        earlier = octree.joined(parts[:number])
        writer = Writer()
        octree.code_cells(writer, shares, len(part), earlier, part)
        data = writer.finish()
        found = cells_of(FastReader, data, shares, len(part), earlier)
        assert found == (part.levels.tolist(), part.codes.tolist())
        for rows in (len(part) - 1, len(part) + 1, 1):
            assert cells_of(FastReader, data, shares, rows, earlier) == cells_of(Reader, data, shares, rows, earlier)
        for _ in range(20):
            damaged = bytearray(data)
            damaged[rng.integers(len(data))] ^= 1 << rng.integers(8)
            args = (bytes(damaged), shares, len(part), earlier)
            assert cells_of(FastReader, *args) == cells_of(Reader, *args)


def test_running_means_and_features_are_the_same_integers(plain):
    scene = made_up(700)
    levels = scene.levels.clone()
    levels[:40] += 6  # some deeper than the cells go
    codes = torch.from_numpy(octree.morton.encode(scene.cells.numpy())) << 3 * (levels - scene.levels)
    rng = np.random.default_rng(3)
    values, indices = (torch.from_numpy(rng.integers(-(1 << 21), 1 << 21, (700, 22))) for _ in range(2))

    def walk() -> torch.Tensor:
        means, rows, found = pyramid_of(torch.arange(22) * 160), torch.arange(700), []
        means.announce(levels[:400], codes[:400])
        found.append(means.features(rows[:400]).clone())
        means.add(rows[:400:2], BASE, values[:400:2, BASE], indices[:400:2, BASE])
        found.append(means.features(rows[1:400:2]).clone())
        means.announce(levels[400:], codes[400:])
        means.add(rows[5:600:3], VIEW, values[5:600:3, VIEW], indices[5:600:3, VIEW])
        means.refine(rows[:400:2], REFINED, values[:400:2, REFINED], values[1:400:2, REFINED])
        found.append(means.features(rows.flip(0)))
        return torch.cat(found)

    assert torch.equal(walk(), plain(walk))


@pytest.mark.parametrize("rows", [slice(1, 800, 3), slice(0, 800), slice(5, 6)])
def test_ties_add_the_same_integers(plain, rows):
    rng, context = np.random.default_rng(4), some_networks().exact()
    index, scale = rng.integers(-(1 << 21), 1 << 21, (800, 22)), rng.integers(0, 63 * 4096 + 1, (800, 22))
    index[::2] //= 1 << 16
    parts = {"index": index, "scale": scale, "multiplier": rng.integers(64, 8192, (800, 22))}
    state, at = SimpleNamespace(**{name: part.astype(np.int32) for name, part in parts.items()}), np.arange(800)[rows]
    for part in (PARTS[1][1], *PARTS[2][1:], *PARTS[3][1:]):
        ours, theirs = context.moved(part, at, state), plain(lambda p=part: context.moved(p, at, state))
        for one, other in zip(ours, theirs, strict=True):
            assert np.array_equal(one, other)
            assert one.any()


@pytest.mark.parametrize("planes", [0, 2])
@pytest.mark.parametrize("rows", [slice(1, 400, 3), slice(7, 8)])
def test_forecasts_are_kept_as_the_same_integers(plain, rows, planes):
    rng, at, columns = np.random.default_rng(5), np.arange(400)[rows], slice(2, 6)
    features = torch.from_numpy(rng.integers(-(1 << 20), 1 << 20, (len(at), 69)))
    outputs = torch.from_numpy(rng.integers(-(1 << 21), 1 << 21, (len(at), 14)))
    outputs[::2] >>= 5
    more = rng.integers(-(1 << 18), 1 << 18, (2, len(at), 4))

    def keep() -> list[np.ndarray]:
        found = []
        for adaptive in (False, True):
            context = some_networks().exact()
            context.adaptive, context._features = adaptive, features
            context._networks[1] = lambda *_: outputs
            state = packets.State(octree.joined([]), *(np.zeros((400, 22), np.int32) for _ in range(4)))
            state.index[:] = rng.integers(-(1 << 21), 1 << 21, state.index.shape)
            found += [state.index.copy(), *context.predict(BLOCKS[1], at, state).__dict__.values()]
            for moved in (None, more):
                prediction = packets.Prediction(*found[-3:])
                tables = packets.kept(prediction, 1, moved, columns, at, state, planes)
                assert len(np.unique(tables)) > 1 or len(at) == 1
                found[-3:-3] = [tables, state.mean.copy(), state.scale.copy(), state.multiplier.copy()]
                found[-3:-3] = [state.units(at, columns)]
        return found

    rng = np.random.default_rng(6)
    ours = keep()
    rng = np.random.default_rng(6)
    theirs = plain(keep)
    assert len(ours) == len(theirs)
    for one, other in zip(ours, theirs, strict=True):
        assert np.array_equal(one, other)


def test_axes_are_those_of_the_plain_code(plain):
    draws = torch.Generator().manual_seed(0)
    six = torch.randn(3_000, 6, dtype=torch.float64, generator=draws)
    six[:400, [1, 2, 4]] = 0  # axes of the world
    six[:200, 3] = six[:200, 0]  # two alike
    six[:100, 5] = six[:100, 0]
    six[400:800] *= 1e-5
    numbers = numbers_of(six)
    ours, theirs = scales_and_quats(*numbers), plain(lambda: scales_and_quats(*numbers))
    assert torch.allclose(ours[0], theirs[0], rtol=0, atol=1e-12)
    apart = (theirs[0].diff(dim=1) > 1e-4 * theirs[0].abs().amax(1, keepdim=True)).all(1)  # else any axes will do
    assert apart[800:].all()
    found = (ours[1] * theirs[1]).sum(1).abs()  # of rotations by half a turn w is 0, and either sign right
    assert torch.allclose(found[apart], torch.ones_like(found[apart]), rtol=0, atol=1e-9)
    assert torch.allclose(ours[1].norm(dim=1), torch.ones(3_000, dtype=torch.float64))
    again = log_covariance(*ours)
    for one, other in zip(again, numbers, strict=True):
        assert torch.allclose(one, other, rtol=0, atol=1e-9)


def test_senseless_calls_are_refused():
    shape = {
        "cells": 1,
        "values": torch.zeros(1, 2).long(),
        "own": torch.zeros(3, 4),
        "sums": torch.zeros(2, 4).double(),
    }
    parent, leaf, rows = torch.tensor([1, 1]), torch.zeros(3, dtype=torch.int64), torch.tensor([0])
    for changed in ({"rows": torch.tensor([3])}, {"leaf": leaf + 1}, {"first": 3}):
        with pytest.raises(RuntimeError, match=r"row|cell|columns"):
            exact_face.pyramid_add(**{"rows": rows, "leaf": leaf, "parent": parent, "first": 0} | shape | changed)
    splats = torch.zeros(3, 22, dtype=torch.int32)
    shape = {"index": splats, "scale": splats, "multiplier": splats, "sizes": torch.zeros(64, dtype=torch.int64)}
    shape |= {"weights": torch.zeros(2, 1, 4, dtype=torch.int64), "moved": torch.zeros(2, 2, 1, dtype=torch.int64)}
    for changed in ({"first": 2}, {"first": -1}, {"step": 0}, {"start": 19}):
        with pytest.raises(RuntimeError, match=r"row|columns"):
            exact_face.moved(**{"first": 0, "step": 1, "start": 0} | shape | changed)
    block = torch.zeros(2, 3, dtype=torch.int64)
    shape = {"mean": block, "scale": block, "multiplier": block, "lower": 0, "tables": torch.zeros(2, 2).byte()}
    shape |= {"to_mean": splats, "to_scale": splats, "to_multiplier": splats}
    for changed in ({"first": 2}, {"step": 0}, {"start": 21}, {"begin": 2}, {"begin": -1}):
        with pytest.raises(RuntimeError, match=r"row|columns"):
            exact_face.kept(**{"first": 0, "step": 1, "start": 0, "begin": 0} | shape | changed)
    shape = {"mean": splats, "index": splats, "multiplier": splats, "found": torch.zeros(2, 3, dtype=torch.int64)}
    for changed in ({"first": 2}, {"step": -1}, {"start": 20}):
        with pytest.raises(RuntimeError, match=r"row|columns"):
            exact_face.values(**{"first": 0, "step": 1, "start": 0} | shape | changed)
    shape = {"features": block, "outputs": torch.zeros(2, 5).long(), "mean": block[:, :2].contiguous()}
    shape |= {"scale": shape["mean"], "multiplier": shape["mean"]}
    for start, steps in ((2, [0, 0]), (-1, [0, 0]), (0, [0, 1]), (0, [-1, 0])):
        with pytest.raises(RuntimeError, match="column"):
            exact_face.forecasts(start=start, step_of=torch.tensor(steps), **shape)
    words = torch.zeros(8, dtype=torch.uint8)
    for state, zeros in (([0, -1, 0, 3], 5), ([0, 1, 0, 2], 5), ([0, -1, 0, 2], 0)):
        with pytest.raises(RuntimeError, match=r"words|range|zeros"):
            codecs_face.range_bits(
                words=words, state=torch.tensor(state), zeros=torch.tensor([zeros], dtype=torch.int32),
                bits=torch.empty(1, dtype=torch.bool),
            )  # fmt: skip
