"""Spark's .rad: leaves and cuts of its tree, every encoding, and files that were made to do harm."""

import json
import struct
import tracemalloc

import numpy as np
import pytest
from rad_files import PLAIN, deflated, framed, padded, rad_chunk, rad_file, random_rows
from refusals import refusal
from sw_interchange import Limits, decode, read
from sw_interchange.scene import sigmoid

from splatwizard_core.api import SplatwizardError, UserInputError

LIMITS = Limits(max_gaussians=1 << 20, max_output_bytes=1 << 28)
MEMORY = 256 << 20
LINES = 100_000  # of Python; none needs a tenth
QUANTISED = {"center": "f32_lebytes", "alpha": "r8", "rgb": "r8_delta", "scales": "ln_0r8", "orientation": "oct88r8",
             "sh1": "s8", "sh2": "s8_delta", "sh3": "r8"}  # fmt: skip


def check(found, rows, *, close: float = 1e-6, turn: float = 1e-6):
    assert np.allclose(found.means, rows["center"], atol=1e-6)
    assert np.allclose(np.exp(found.log_scales), rows["scales"], rtol=max(close, 1e-5))
    assert np.allclose(sigmoid(found.opacity_logits), rows["alpha"][:, 0], atol=close)
    assert np.allclose(0.5 + 0.28209479177387814 * found.sh_dc, rows["rgb"], atol=close)
    same = np.abs((found.quats * rows["orientation"][:, [3, 0, 1, 2]]).sum(axis=1))
    assert same.min() > 1 - turn
    for band in range(1, found.sh_degree + 1):
        values = found.sh_rest[:, band**2 - 1 : (band + 1) ** 2 - 1].reshape(len(same), -1)
        assert np.allclose(values, rows[f"sh{band}"], atol=close)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_floats_come_back_as_they_are(degree):
    rows = random_rows(50, degree)
    found = decode(rad_file(rows, chunk=20), name="x.rad")
    assert found.report.format == "rad"
    assert found.sh_degree == degree
    check(found, rows)


def test_quantised_ones_are_off_by_half_a_step():
    rows = random_rows(200, 3)
    # Steps of 8 bits: 1/255 of at most 1, 2 ln(largest) / 254 of scales, 0.5 degrees of an axis.
    check(decode(rad_file(rows, QUANTISED), name="x.rad"), rows, close=0.012, turn=2e-4)


@pytest.mark.parametrize(
    ("encoding", "off"), [("f16", 1e-3), ("f16_lebytes", 1e-3), ("ln_f16", 3e-3), ("f32_lebytes", 0)]
)
def test_an_encoding_of_scales(encoding, off):
    rows = random_rows(50, 0)
    found = decode(rad_file(rows, {"scales": encoding}), name="x.rad")
    assert np.allclose(np.exp(found.log_scales), rows["scales"], rtol=off + 1e-5)


@pytest.mark.parametrize("wbits", [-15, 15, 31], ids=["raw", "zlib", "gzip"])
def test_deflate_in_any_wrapping(wbits):
    rows = random_rows(300, 1)
    check(decode(rad_file(rows, wbits=wbits), name="x.rad"), rows)


def test_the_leaves_of_a_tree_are_the_scene():
    rows = random_rows(101, 1, tree=True)
    found = decode(rad_file(rows, chunk=40), name="x.rad")
    check(found, {name: values[50:] for name, values in rows.items()})


def test_a_level_is_a_cut_that_covers_every_leaf_once(tmp_path):
    rows = random_rows(101, 0, tree=True)
    (tmp_path / "x.rad").write_bytes(rad_file(rows))
    for level, most in ((1, 25), (2, 12), (5, 1)):
        found = read(tmp_path / "x.rad", level=level)
        assert most - 1 <= found.num_gaussians <= most
        chosen = {int(np.abs(rows["center"] - mean).sum(axis=1).argmin()) for mean in found.means}
        for leaf in range(50, 101):
            above = [leaf]
            while above[-1]:
                above.append((above[-1] - 1) // 2)
            assert len(chosen & set(above)) == 1


def test_chunks_may_lie_beside(tmp_path):
    rows = random_rows(30, 0)
    (tmp_path / "x-0.radc").write_bytes(rad_chunk(rows, 0, PLAIN))
    header = {"version": 1, "type": "gsplat", "count": 30, "maxSh": 0,
              "chunks": [{"offset": 0, "bytes": 1, "filename": "x-0.radc"}]}  # fmt: skip
    (tmp_path / "x.rad").write_bytes(framed(b"RAD0", header))
    check(read(tmp_path / "x.rad"), rows)


def test_a_codebook_of_sh_is_left_out_and_told():
    rows = random_rows(30, 0)
    rows["sh_label"] = np.zeros((30, 1))
    found = decode(rad_file(rows, {"sh_label": "u16"}, maxSh=1), name="x.rad")
    assert "codebook" in found.report.warnings[0]


def test_no_such_level_is_told(tmp_path):
    (tmp_path / "x.rad").write_bytes(rad_file(random_rows(5, 0)))
    with pytest.raises(UserInputError, match="no level -1"):
        read(tmp_path / "x.rad", level=-1)


def with_chunk(**changes) -> bytes:
    """A file of one chunk whose description is changed."""
    rows = random_rows(30, 0)
    chunk = rad_chunk(rows, 0, PLAIN, **changes)
    header = {"version": 1, "count": 30, "maxSh": 0, "chunks": [{"offset": 0, "bytes": len(chunk)}]}
    return framed(b"RAD0", header) + chunk


def with_property(**changes) -> bytes:
    """A file whose first property is changed."""
    rows = random_rows(30, 0)
    whole = rad_chunk(rows, 0, PLAIN)
    length = struct.unpack_from("<I", whole, 4)[0]
    told = json.loads(whole[8 : 8 + length])
    told["properties"][0] |= changes
    return with_chunk(properties=told["properties"])


def bomb() -> bytes:
    content = deflated(bytes(1 << 26))
    place = {"offset": 0, "bytes": len(content), "property": "center", "encoding": "f32", "compression": "gz"}
    told = {"base": 0, "count": 30, "properties": [place]}
    chunk = framed(b"RADC", told) + struct.pack("<Q", len(content)) + padded(content)
    header = {"version": 1, "count": 30, "maxSh": 0, "chunks": [{"offset": 0, "bytes": len(chunk)}]}
    return framed(b"RAD0", header) + chunk


def tree(counts: list[int], starts: list[int]) -> bytes:
    rows = random_rows(len(counts), 0)
    rows |= {"child_count": np.array(counts)[:, None], "child_start": np.array(starts)[:, None]}
    return rad_file(rows)


def two_chunks(**second: int) -> bytes:
    rows = random_rows(30, 0)
    size = len(rad_chunk({name: values[:15] for name, values in rows.items()}, 0, PLAIN))
    return rad_file(rows, chunk=15, chunks=[{"offset": 0, "bytes": size}, {"offset": size, "bytes": size} | second])


SOUND = rad_file(random_rows(31, 1, tree=True), chunk=16)
BAD = {
    "nothing": b"RAD0",
    "a length of 4 GiB": b"RAD0" + struct.pack("<I", 0xFFFFFFFF) + b"{}" * 100,
    "no JSON": framed(b"RAD0", {}).replace(b"{}", b"[["),
    "nested": b"RAD0" + struct.pack("<I", 100_000) + b"[" * 100_000,
    "a list": b"RAD0" + struct.pack("<I", 2) + b"[]      ",
    "no version": framed(b"RAD0", {"count": 5}),
    "no chunks": framed(b"RAD0", {"version": 1, "count": 5}),
    "too few rows": rad_file(random_rows(5, 0), count=4),
    "too many rows": rad_file(random_rows(5, 0), count=6),
    "a huge count": rad_file(random_rows(5, 0), count=1 << 62),
    "degree 9": rad_file(random_rows(5, 0), maxSh=9),
    "a chunk twice": two_chunks(offset=0),
    "a chunk backwards": two_chunks(offset=-8),
    "a chunk beyond": two_chunks(offset=1 << 40),
    "another base": two_chunks(base=3),
    "an empty chunk": with_chunk(count=0),
    "fewer rows in the chunk": with_chunk(count=29),
    "more payload": with_chunk(payloadBytes=1 << 40),
    "no properties": with_chunk(properties=[]),
    "many properties": with_chunk(properties=[{"property": str(i)} for i in range(100_000)][:9000]),
    "a property beyond": with_property(offset=1 << 30),
    "a property without bytes": with_property(bytes=0),
    "an encoding to come": with_property(encoding="f128"),
    "whole numbers for a place": with_property(encoding="u32"),
    "a rotation for a place": with_property(encoding="oct88r8"),
    "another packing": with_property(compression="brotli"),
    "no range": with_property(encoding="r8"),
    "not a number": with_property(encoding="r8", min="a", max=1),
    "not deflated": with_property(compression=None),
    "a bomb": bomb(),
    "children before": tree([2, 0, 0], [0, 0, 0]),
    "a loop": tree([1, 1, 0], [1, 1, 0]),
    "two parents": tree([2, 1, 0], [1, 2, 0]),
    "no parent": tree([1, 0, 0], [1, 0, 0]),
    "children beyond": tree([2, 0], [1, 0]),
    "65,535 children": tree([65535, 0, 0], [1, 0, 0]),
    "a path": rad_file(random_rows(5, 0), chunks=[{"bytes": 5, "offset": 0, "filename": "../x.radc"}]),
    "another file": rad_file(random_rows(5, 0), chunks=[{"bytes": 5, "offset": 0, "filename": "passwd"}]),
    **{f"cut at {end}": SOUND[:end] for end in range(9, len(SOUND) - 8, 211)},
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_file_is_refused_in_two_lines(name):
    tracemalloc.start()
    lines, message = refusal(lambda: decode(BAD[name], "rad", name="bad.rad", limits=LIMITS))
    assert lines < LINES
    assert tracemalloc.get_traced_memory()[1] < MEMORY
    tracemalloc.stop()
    assert message.startswith("bad.rad")
    assert len(message) < 300


def test_a_chain_is_no_tree_to_cut(tmp_path):
    count = 6000
    rows = random_rows(count, 0)
    below = np.arange(count) < count - 1
    rows |= {"child_count": below[:, None] * 1, "child_start": (below * (np.arange(count) + 1))[:, None]}
    (tmp_path / "x.rad").write_bytes(rad_file(rows))
    assert read(tmp_path / "x.rad").num_gaussians == 1
    with pytest.raises(SplatwizardError, match="deeper"):
        read(tmp_path / "x.rad", level=1)


def test_flipped_bits_give_a_scene_or_a_typed_error():
    rng = np.random.default_rng(0)
    survived = 0
    for _ in range(500):
        data = bytearray(SOUND)
        data[rng.integers(len(data))] ^= 1 << rng.integers(8)
        try:
            assert decode(bytes(data), "rad", name="x.rad", limits=LIMITS).num_gaussians <= 31
            survived += 1
        except SplatwizardError:
            pass
    assert 0 < survived < 500
