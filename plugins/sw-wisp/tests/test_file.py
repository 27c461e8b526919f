import contextlib
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from wisp_scenes import made_up

from splatwizard_core.api import BitstreamError, ContainerReader, ContainerWriter
from splatwizard_core.tooling import Prefix
from sw_wisp import file
from sw_wisp.nested import Counter
from sw_wisp.numbers import BASE_STEPS, LIMITS
from sw_wisp.packets import default_order


def written(scene) -> tuple[bytes, file.Encoded]:
    writer = ContainerWriter("wisp", 1)
    encoded = file.encode(scene, writer)
    return writer.to_bytes(), encoded


@pytest.mark.parametrize(("subsets", "planes"), [(1, 0), (1, 1), (4, 1), (3, 2), (2, 0)])
def test_values_return_within_half_a_step(subsets, planes):
    scene = made_up(1500, subsets=subsets, planes=planes)
    data, encoded = written(scene)
    decoded = file.decode(ContainerReader(data))
    assert decoded.digest() == encoded.decoded.digest()
    wanted = np.clip(scene.values.numpy(), -np.array(LIMITS), np.array(LIMITS))[encoded.rows]
    assert (np.abs(decoded.values().numpy() - wanted) <= 0.5001 * np.array(BASE_STEPS)).all()
    centres = scene.cube.centres(scene.levels, scene.cells)[encoded.rows]
    assert torch.equal(decoded.means(), centres)


@pytest.mark.parametrize("n", [0, 1, 2])
def test_few_splats_return(n):
    data, encoded = written(made_up(n))
    assert file.decode(ContainerReader(data)).digest() == encoded.decoded.digest()
    assert len(encoded.decoded) == n


def test_a_fresh_process_decodes_the_same_integers(tmp_path):
    data, encoded = written(made_up(800, subsets=4, planes=1))
    (tmp_path / "scene.swz").write_bytes(data)
    code = (
        "import sys; from splatwizard_core.api import ContainerReader; from sw_wisp import file;"
        "print(file.decode(ContainerReader.open(sys.argv[1])).digest())"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "scene.swz")]
    digest = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    assert digest == encoded.decoded.digest()


def test_encoding_again_gives_the_same_bytes_in_any_order_of_rows():
    scene = made_up(900, subsets=3, planes=1)
    data, _ = written(scene)
    rows = np.random.default_rng(1).permutation(900)
    parts = {name: getattr(scene, name)[rows] for name in ("levels", "cells", "values", "subsets")}
    assert written(file.Scene(scene.cube, appearance=scene.appearance, planes=1, **parts))[0] == data


@pytest.mark.parametrize("subsets", [1, 4])
def test_every_prefix_is_exact_and_what_is_final_stays(subsets):
    data, encoded = written(made_up(600, subsets=subsets, planes=1))
    count, whole = 3 * subsets, encoded.decoded.state
    for packets in range(1, count + 1):
        state = file.decode(ContainerReader(data, prefix=Prefix(packets))).state
        n = len(state.levels)
        assert np.array_equal(state.levels, whole.levels[:n])
        assert np.array_equal(state.mean[:, :10], whole.mean[:n, :10])
        assert np.array_equal(state.mean[state.has_view], whole.mean[:n][state.has_view])
        done = state.planes == 0
        assert np.array_equal(state.index[done, :10], whole.index[:n][done, :10])
        away = np.abs(state.index[:, 1:10] - whole.index[:n, 1:10])
        assert away.max(initial=0) <= 1
        assert np.array_equal(state.index[state.has_view, 10:], whole.index[:n][state.has_view, 10:])
        assert (state.index[~state.has_view, 10:] == 0).all()


def test_a_file_that_ends_at_a_cut_is_what_its_packets_are():
    data, _ = written(made_up(600, subsets=2, planes=1))
    for packets, cut in enumerate(ContainerReader(data).summary()["cuts"], 1):
        part = file.decode(ContainerReader(data, prefix=Prefix(packets)))
        assert file.decode(ContainerReader(data[: cut["bytes"]])).digest() == part.digest()
    assert packets == 6


def test_cuts_that_are_not_worth_it_are_none():
    psnr = (20.0, 21.0, 20.5, 20.5, 22.0, 23.0)
    reader = ContainerReader(written(made_up(600, subsets=2, planes=1, psnr=psnr))[0])
    assert [(cut.sections, cut.psnr) for cut in reader.cuts] == [
        (2, 20.0), (4, 20.5), (5, 20.5), (6, 22.0), (7, 23.0)
    ]  # fmt: skip
    two = replace(made_up(600, subsets=2, planes=1), subsets=np.zeros(600, int), order=default_order(2, 1))
    empty = ContainerReader(written(two)[0])
    assert [cut.sections for cut in empty.cuts] == [2, 4, 7]  # packets of no splats have no bytes
    assert len(file.decode(empty)) == 600


def test_order_for_four_subsets():
    letters = [f"{subset + 1}{kind[0]}" for subset, kind in default_order(4, 1)]
    assert " ".join(letters) == "1b 1f 2b 1v 2f 3b 2v 3f 4b 3v 4f 4v"


def test_estimate_is_the_size_of_the_file():
    scene = made_up(20_000)
    data, encoded = written(scene)
    reader = ContainerReader(data)
    counter, walk = Counter(), None
    with reader.decoding("networks") as section:
        parts = file.ByteReader(section)
        shares = file.Shares.unpack(parts)
        context = file.StaticContext.unpack(parts)
    state = encoded.decoded.state
    walk = file.Walk(context, shares, 0, [state.cells], lambda rows, columns, _: state.index[rows, columns])
    for packet in (file.Packet(0, "base", 20_000), file.Packet(0, "view", 20_000)):
        walk.packet(counter, packet)
    payload = sum(size for name, size in reader.sections.items() if name != "networks")
    assert counter.total == pytest.approx(8 * payload, rel=0.005)


def test_crowded_cells_and_senseless_values_are_refused():
    scene = made_up(50)
    crowded = file.Scene(scene.cube, scene.levels * 0 + 3, scene.cells * 0, scene.values, scene.appearance)
    with pytest.raises(ValueError, match="more than 16"):
        written(crowded)
    values = scene.values.clone()
    values[3, 4] = float("nan")
    with pytest.raises(ValueError, match="finite"):
        written(file.Scene(scene.cube, scene.levels, scene.cells, values, scene.appearance))


CLAIMS = {
    "rows": {"order": [[0, "base", 2**31], [0, "view", 2**31]]},
    "many rows": {"order": [[0, "base", 2**26], [0, "view", 2**26]]},
    "other rows": {"order": [[0, "base", 301], [0, "view", 301]]},
    "view first": {"order": [[0, "view", 300], [0, "base", 300]]},
    "fine without planes": {"order": [[0, "base", 300], [0, "fine", 300]]},
    "more packets": {"order": [[0, "base", 300], [0, "view", 300], [1, "base", 0], [1, "view", 0]]},
    "no subset 0": {"order": [[1, "base", 300], [1, "view", 300]]},
    "unknown kind": {"order": [[0, "basis", 300], [0, "view", 300]]},
    "an order that is none": {"order": 7},
    "base steps": {"base_steps": [0.0] * 22},
    "few base steps": {"base_steps": [1.0] * 21},
    "planes": {"planes": 7},
    "swell of one subset": {"swell": [[1, 1]]},
    "swell that is none": {"swell": 7},
    "context": {"context": "oracle"},
    "edge": {"edge": -1.0},
    "corner": {"low": [1e300, 0, 0]},
    "layers": {"appearance": [[4096, 4096, 1]] * 3},
    "tables": {"tables": [1, 5]},
}


@pytest.mark.parametrize("claim", CLAIMS)
def test_headers_that_make_no_sense_are_refused(claim):
    reader = ContainerReader(written(made_up(300))[0])
    writer = ContainerWriter("wisp", 1)
    writer.static.update(reader.static | CLAIMS[claim])
    for name in reader.sections:
        writer.add(name, reader.section(name))
    with pytest.raises(BitstreamError):
        file.decode(ContainerReader(writer.to_bytes()))


SWELL = {
    "rows": [[1, 2]],
    "numbers": [[1, 2, 3], [1, 2, 3, 4]],
    "text": [["a", 1], [1] * 4],
    "large": [[1, 2], [200] * 4],
}


@pytest.mark.parametrize("claim", SWELL)
def test_what_swells_prefixes_must_make_sense(claim):
    scene = made_up(90, subsets=3, planes=1, swell=[[8, -4], [1, 2, 3, 4]])
    data, _ = written(scene)
    with pytest.raises(BitstreamError, match="swell"):
        file.decode(ContainerReader(written(replace(scene, swell=SWELL[claim]))[0]))
    part = file.decode(ContainerReader(data, prefix=Prefix(2)))
    flat = file.decode(ContainerReader(written(replace(scene, swell=()))[0], prefix=Prefix(2)))
    added = part.values() - flat.values()
    assert torch.allclose(added[:, 6], torch.tensor(0.25), atol=1e-6)
    assert torch.allclose(added[:, 0], torch.tensor(-0.125), atol=1e-6)
    assert part.digest() == flat.digest()


def test_flipped_bytes_within_sections_raise_or_decode_to_something():
    reader = ContainerReader(written(made_up(200, subsets=2, planes=1))[0])
    sections = {name: reader.section(name) for name in reader.sections}
    rng = np.random.default_rng(0)
    for _ in range(50):
        name = str(rng.choice(list(sections)))
        damaged = bytearray(sections[name])
        damaged[rng.integers(len(damaged))] ^= 1 << rng.integers(8)
        writer = ContainerWriter("wisp", 1)
        writer.static.update(reader.static)
        for other, data in sections.items():
            writer.add(other, bytes(damaged) if other == name else data)
        try:
            decoded = file.decode(ContainerReader(writer.to_bytes()))
        except BitstreamError:
            continue
        assert bool(torch.isfinite(decoded.values()).all())


def test_cut_sections_raise_or_decode_to_something():
    reader = ContainerReader(written(made_up(200))[0])
    for name in reader.sections:
        for keep in (0, 1, 4, len(reader.section(name)) - 4):
            writer = ContainerWriter("wisp", 1)
            parts = {n: reader.section(n)[: keep if n == name else None] for n in reader.sections}
            writer.static.update(reader.static)
            for other, part in parts.items():
                writer.add(other, part)
            with contextlib.suppress(BitstreamError):
                assert len(file.decode(ContainerReader(writer.to_bytes()))) == 200
