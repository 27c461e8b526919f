"""A file from a stranger is refused, or decodes to finite splats, in memory bounded by the rows it may claim.

A few hundred files in the default tests; more with `python -m pytest -m fuzz plugins/sw-wisp/tests -s`
(SPLATWIZARD_FUZZ_FILES sets how many).
"""

import os
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from sw_kit.hostile_files import Mutator, Parts, Tally, attempt
from test_context import some_networks
from wisp_scenes import made_up

from splatwizard_core.api import BitstreamError, ContainerReader, ContainerWriter
from sw_codecs.exact_native import EXACT as CODECS
from sw_wisp import file
from sw_wisp.fast import running_means, streams
from sw_wisp.fast.exact_native import EXACT
from sw_wisp.nested import Reader, Writer
from sw_wisp.octree import Cells, code_cells, fit_shares, joined
from sw_wisp.octree_contexts import ENDS, LEVELS, MORE, Shares

NOISE = 16 << 20  # of the allocator, and of the tables that are made once
FREE = 1 << 24  # bytes of rows that any file may stand for
FUZZ_FILES = int(os.environ.get("SPLATWIZARD_FUZZ_FILES", "10000"))


def written(scene) -> bytes:
    writer = ContainerWriter("wisp", 1)
    file.encode(scene, writer)
    return writer.to_bytes()


@pytest.fixture(scope="module")
def seeds() -> list[bytes]:
    context = some_networks().exact()
    return [
        written(made_up(150)),
        written(made_up(150, subsets=3, planes=1)),
        written(replace(made_up(150), context=context)),
        written(replace(made_up(150, subsets=2, planes=2), context=context)),
        written(made_up(0)),
    ]


def decoded(data: bytes) -> str:
    found = file.decode(ContainerReader(data))
    assert bool(torch.isfinite(found.values()).all())
    assert bool(torch.isfinite(found.means()).all())
    assert len(found.digest()) == 64
    return "decoded"


def fuzz(seeds: list[bytes], number: int, seed: int) -> Tally:
    tally, mutator = Tally(), Mutator(seed)
    decoded(seeds[3])  # tables and native code are there
    for i in range(number):
        data, kind = mutator.file(seeds)
        attempt(lambda data=data: decoded(data), f"file {seed}/{i} ({kind})", 4 * FREE + NOISE, tally)
        if len(tally.problems) > 10:
            break
    return tally


@pytest.mark.parametrize(("decoder", "files"), [("compiled", 120), ("plain", 45)])
def test_hostile_files_are_refused_or_decode_to_something(seeds, monkeypatch, decoder, files):
    if decoder == "plain":
        for module in (streams, running_means):
            monkeypatch.setattr(module, "EXACT", SimpleNamespace(try_load=lambda: False))
    elif not (CODECS.try_load() and EXACT.try_load()):
        pytest.skip("there are no compiled kernels")
    tally = fuzz(seeds, files, 1)
    assert tally.problems == []
    assert tally.outcomes["refused"] > files / 3
    assert tally.outcomes["decoded"] > files / 24


@pytest.mark.parametrize("claim", [(0, 16, 1), (5, 4, 1), (0, 3, 2), (255, 255, 3)])
def test_levels_beyond_the_octree_are_refused(seeds, claim):
    parts = Parts.of(seeds[0])
    sections = dict(parts.sections)
    sections["networks"] = bytes(claim) + sections["networks"][3:]
    parts.sections = list(sections.items())
    with pytest.raises(BitstreamError, match="octree is said to have"):
        decoded(parts.join())


@pytest.mark.parametrize("ahead", ["fine", "view"])
def test_packets_before_their_base_are_refused(seeds, ahead):
    parts = Parts.of(seeds[1])
    order = parts.header["static"]["order"]
    place = next(i for i, (subset, kind, _) in enumerate(order) if (subset, kind) == (2, ahead))
    order.insert(0, order.pop(place))
    with pytest.raises(BitstreamError, match="subset 2 has the packets"):
        decoded(parts.join())


def test_no_cell_can_hold_seventeen():
    """There is no bit for a seventeenth: what says "one more" to the end stands for sixteen."""
    cells = Cells(np.full(16, 3), np.full(16, 77))
    shares, writer = fit_shares([cells]), Writer()
    code_cells(writer, shares, 16, joined([]), cells)
    data = writer.finish()
    for reader in (Reader(data), streams.reader_of(data)):
        assert np.array_equal(code_cells(reader, shares, 16, joined([]), None).codes, cells.codes)
        reader.finish()
    for reader in (Reader(data), streams.reader_of(data)):
        with pytest.raises(BitstreamError):
            code_cells(reader, shares, 17, joined([]), None)


@pytest.mark.slow
@pytest.mark.fuzz
@pytest.mark.timeout(3600)
def test_many_hostile_files(seeds):
    tally = fuzz(seeds, FUZZ_FILES, 2)
    print(f"\n{dict(tally.outcomes)}; slowest {tally.slowest_s:.3f} s; growth {tally.largest_growth / 1e6:.1f} MB")
    assert tally.problems == []


def test_flipped_bytes_are_refused(seeds):
    data, rng = seeds[3], np.random.default_rng(0)
    for at in rng.integers(len(data), size=400).tolist():
        damaged = bytearray(data)
        damaged[at] ^= 1 << int(rng.integers(8))
        with pytest.raises(BitstreamError):
            file.decode(ContainerReader(bytes(damaged)))


def test_every_length_is_refused_but_cuts(seeds):
    data = seeds[1]
    cuts = {cut["bytes"] for cut in ContainerReader(data).summary()["cuts"]}
    assert len(cuts) == 9
    for length in {*np.random.default_rng(0).integers(len(data), size=300).tolist()} - cuts:
        with pytest.raises(BitstreamError):
            file.decode(ContainerReader(data[:length]))
    assert {decoded(data[:length]) for length in cuts} == {"decoded"}


@pytest.mark.parametrize("rows", [2**31, 2**26, 2**20])
def test_rows_that_bytes_cannot_hold_are_refused_without_their_memory(seeds, rows):
    parts = Parts.of(seeds[0])
    parts.header["static"]["order"] = [[0, "base", rows], [0, "view", rows]]
    data, tally = parts.join(), Tally()
    with pytest.raises(BitstreamError):
        file.decode(ContainerReader(data))
    attempt(lambda: decoded(data), "rows", NOISE, tally)
    assert tally.problems == []


def test_an_octree_of_many_nodes_and_few_splats_is_refused():
    """All bits 1: more cells than announced splats can fill."""
    stream = Writer()
    stream.bits(np.full(200_000, 4095), np.ones(200_000, bool))
    shares = Shares(np.full((LEVELS, 4), 4095), np.zeros(ENDS, np.int64), np.zeros((LEVELS, MORE), np.int64))
    scene = made_up(3)
    parts = Parts.of(written(scene))
    networks = dict(parts.sections)["networks"]
    reader = file.ByteReader(networks)
    Shares.unpack(reader)
    rest = networks[len(networks) - reader.left :]
    sections = {"networks": shares.pack() + rest, "packet.01": stream.finish(), "packet.02": bytes(4)}
    parts.sections = list(sections.items())
    static = parts.header["static"]
    static["order"] = [[0, "base", 20_000], [0, "view", 20_000]]
    tally = Tally()
    with pytest.raises(BitstreamError, match="octree has more"):
        file.decode(ContainerReader(parts.join()))
    attempt(lambda: decoded(parts.join()), "nodes", 100 << 20, tally)
    assert tally.problems == []


def test_largest_weights_of_the_context_still_add_up_exactly():
    """Rows of weights 127 x 2^5 in every network stay below 2^53; finer exponents than 2^-12 are refused."""
    context = some_networks().exact()
    layers = tuple(
        replace(layer, weights=np.full_like(layer.weights, 127), exponents=np.full_like(layer.exponents, 5))
        for layer in context.layers
    )
    ties = tuple(
        replace(tie, weights=np.full_like(tie.weights, 127), exponents=np.full_like(tie.exponents, 5))
        for tie in context.ties
    )
    largest = file.PyramidContext(context.prior, layers, ties)
    data = written(replace(made_up(60), context=largest))
    assert decoded(data) == "decoded"
    fine = replace(context.layers[0], exponents=np.full_like(context.layers[0].exponents, -13))
    with pytest.raises(BitstreamError, match="finer"):
        file.PyramidContext.unpack(
            file.ByteReader(file.PyramidContext(context.prior, (fine, *context.layers[1:]), context.ties).pack())
        )
    for changed in (
        replace(context.ties[2], exponents=np.full_like(context.ties[2].exponents, -13)),
        replace(context.ties[2], weights=np.full_like(context.ties[2].weights, -128)),
    ):
        damaged = replace(context, ties=(*context.ties[:2], changed, *context.ties[3:]))
        with pytest.raises(BitstreamError, match="of a tie is out of range"):
            file.PyramidContext.unpack(file.ByteReader(damaged.pack()))
