"""Morton codes and the position codecs: sets and multisets of points, sizes, damage, hostile claims."""

import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from splatwizard_core.errors import BitstreamError, SplatwizardError
from sw_codecs.bits.packing import write_varint
from sw_codecs.entropy.columns import Columns
from sw_codecs.positions import morton
from sw_codecs.positions.octree import Octree
from sw_codecs.positions.plain import MortonDelta, RawPositions

CODECS = [Octree, MortonDelta, RawPositions]


def in_order(points):
    return points[morton.sort(points)]


def clouds():
    r = np.random.default_rng(0)
    flat = r.integers(0, 1 << 16, (3000, 3))
    flat[:, 2] = 77
    u = r.uniform(size=(20_000, 2)) * 2 * np.pi
    torus = np.stack(
        [(2 + np.cos(u[:, 1])) * np.cos(u[:, 0]), (2 + np.cos(u[:, 1])) * np.sin(u[:, 0]), np.sin(u[:, 1])], 1
    )
    return {
        "random": (r.integers(0, 1 << 16, (5000, 3)), 16),
        "planar": (flat, 16),
        "surface": (((torus + 3) / 6 * 65535).astype(int), 16),
        "clustered": (r.integers(0, 1 << 12, (20, 3))[r.integers(0, 20, 4000)] + r.integers(0, 4, (4000, 3)), 13),
        "single": (np.array([[1, 2, 3]]), 21),
        "one-point-many-times": (np.full((500, 3), 9), 4),
        "duplicates": (r.integers(0, 8, (3000, 3)), 10),
        "full": (np.stack(np.meshgrid(*[np.arange(8)] * 3), -1).reshape(-1, 3), 3),
        "one-bit": (r.integers(0, 2, (20, 3)), 1),
        "corners": (np.array([[0, 0, 0], [2**21 - 1] * 3]), 21),
        "wide": (r.integers(0, 1 << 21, (300, 3)), 21),
        "empty": (np.empty((0, 3), int), 16),
    }


def test_morton_code_interleaves_bits():
    assert morton.encode(np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [2, 0, 0], [3, 5, 0]])).tolist() == [
        1,
        2,
        4,
        8,
        0b10001011,
    ]


@given(st.lists(st.tuples(*[st.integers(0, 2**21 - 1)] * 3), max_size=20))
def test_morton_inverts(points):
    array = np.array(points, np.int64).reshape(-1, 3)
    codes = morton.encode(array)
    assert [int(c) for c in codes] == [
        sum((p[a] >> i & 1) << (3 * i + a) for i in range(21) for a in range(3)) for p in points
    ]
    assert np.array_equal(morton.decode(codes), array)


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize("name", list(clouds()))
def test_clouds_come_back_in_order(codec, name):
    points, bits = clouds()[name]
    points = in_order(points)
    found = codec().decode(codec().encode(points, bits))
    assert found.dtype == np.int64
    assert np.array_equal(found, points)


@settings(max_examples=100, deadline=None)
@given(st.sampled_from(CODECS), st.integers(1, 21), st.data())
def test_any_multiset_comes_back(codec, bits, data):
    coordinate = st.integers(0, 2**bits - 1) | st.integers(0, 1)
    points = in_order(np.array(data.draw(st.lists(st.tuples(*[coordinate] * 3), max_size=40)), np.int64).reshape(-1, 3))
    assert np.array_equal(codec().decode(codec().encode(points, bits)), points)


@pytest.mark.parametrize("codec", CODECS)
def test_wrong_points_are_refused(codec):
    good = np.array([[0, 0, 0], [1, 1, 1]])
    for points, bits in (
        (good[::-1], 4), (good - 1, 4), (good * 16, 4), (good * 0.5, 4), (good[:, :2], 4), (good, 0), (good, 22),
    ):  # fmt: skip
        with pytest.raises(ValueError):
            codec().encode(points, bits)


def test_random_points_cost_what_a_random_set_must():
    n, bits = 20_000, 16
    points = in_order(np.random.default_rng(3).integers(0, 1 << bits, (n, 3)))
    # log2 of the number of sets of n points out of 2^48: 48 - log2(n!) / n bits a point.
    ideal = 48 - np.log2(np.arange(1, n + 1)).sum() / n
    assert 8 * len(Octree().encode(points, bits)) / n < 1.02 * ideal


def test_the_octree_beats_the_plain_codecs_on_a_surface():
    points, bits = clouds()["surface"]
    sizes = [len(codec().encode(in_order(points), bits)) for codec in CODECS]
    assert sizes[0] < sizes[1] < sizes[2]


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize("name", ["duplicates", "clustered"])
def test_damage_is_found(assert_survives_damage, codec, name):
    points, bits = clouds()[name]
    points = in_order(points[:60])
    data = codec().encode(points, bits)
    assert_survives_damage(data, codec().decode, points)


def test_codes_so_far_apart_that_their_difference_wraps_are_out_of_order():
    codes = np.array([0, 2**62, 2**63 - 1, -(2**63), -(2**62), 0, 5])
    steps = np.diff(codes, prepend=0)
    columns = np.stack([steps >> 48, steps & (2**48 - 1)], 1)
    head = bytes([1, 4]) + zlib.crc32(codes.astype("<i8")).to_bytes(4, "little") + write_varint(len(codes))
    with pytest.raises(BitstreamError, match="Morton order"):
        MortonDelta().decode(head + Columns().encode(columns))


@pytest.mark.parametrize("codec", CODECS)
def test_claims_of_huge_counts_are_refused(codec):
    points = np.full((70, 3), 5)
    with pytest.raises(BitstreamError, match="at most 60"):
        codec(max_points=60).decode(codec().encode(points, 8))
    with pytest.raises(SplatwizardError, match="more than a reader accepts"):
        codec(max_points=60).encode(points, 8)
    data = codec().encode(points, 8)
    at = 2 if codec is Octree else 6  # where the count stands
    assert data[at] == 70
    with pytest.raises(BitstreamError):
        codec().decode(data[:at] + write_varint(2**40) + data[at + 1 :])


@pytest.mark.parametrize("codec", CODECS)
def test_a_few_bytes_never_stand_for_many_points(codec):
    with pytest.raises(SplatwizardError, match="more than a reader accepts"):
        codec().encode(np.full((100_000, 3), 5), 8)


@settings(max_examples=200, deadline=None)
@given(st.sampled_from(CODECS), st.binary(max_size=60))
def test_random_bytes_are_refused(codec, data):
    for each in (data, bytes([1, 16]) + data):
        with pytest.raises(BitstreamError):
            codec().decode(each)
