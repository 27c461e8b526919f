"""Morton codes and the octree: sets and multisets of points, sizes, damage, hostile claims."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from splatwizard_core.errors import BitstreamError, SplatwizardError
from sw_codecs.bits import zstd_frame
from sw_codecs.bits.packing import write_varint
from sw_codecs.entropy.columns import Columns
from sw_codecs.positions import morton
from sw_codecs.positions.octree import Octree


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


@pytest.mark.parametrize("name", list(clouds()))
def test_clouds_come_back_in_order(name, kernels):
    points, bits = clouds()[name]
    points = in_order(points)
    data = Octree().encode(points, bits)
    for compiled in (True, False):
        kernels(compiled)
        found = Octree().decode(data)
        assert found.dtype == np.int64
        assert np.array_equal(found, points)


@settings(max_examples=100, deadline=None)
@given(st.integers(1, 21), st.data())
def test_any_multiset_comes_back(bits, data):
    coordinate = st.integers(0, 2**bits - 1) | st.integers(0, 1)
    points = in_order(np.array(data.draw(st.lists(st.tuples(*[coordinate] * 3), max_size=40)), np.int64).reshape(-1, 3))
    assert np.array_equal(Octree().decode(Octree().encode(points, bits)), points)


def test_wrong_points_are_refused():
    good = np.array([[0, 0, 0], [1, 1, 1]])
    for points, bits in (
        (good[::-1], 4), (good - 1, 4), (good * 16, 4), (good * 0.5, 4), (good[:, :2], 4), (good, 0), (good, 22),
    ):  # fmt: skip
        with pytest.raises(ValueError):
            Octree().encode(points, bits)


def test_random_points_cost_what_a_random_set_must():
    n, bits = 20_000, 16
    points = in_order(np.random.default_rng(3).integers(0, 1 << bits, (n, 3)))
    # log2 of the number of sets of n points out of 2^48: 48 - log2(n!) / n bits per point.
    ideal = 48 - np.log2(np.arange(1, n + 1)).sum() / n
    assert 8 * len(Octree().encode(points, bits)) / n < 1.02 * ideal


def test_a_surface_costs_less_than_its_steps_along_the_curve():
    points, bits = clouds()["surface"]
    points = in_order(points)
    steps = np.diff(morton.encode(points), prepend=0)
    size = len(Octree().encode(points, bits))
    assert size < len(Columns().encode(np.stack([steps >> 48, steps & (2**48 - 1)], 1)))
    assert size < len(zstd_frame.compress(points.T.astype("<u2").tobytes()))


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("name", ["duplicates", "clustered"])
def test_damage_is_found(assert_survives_damage, name, compiled, kernels):
    kernels(compiled)
    points, bits = clouds()[name]
    points = in_order(points[:60])
    data = Octree().encode(points, bits)
    assert_survives_damage(data, Octree().decode, points)


@pytest.mark.parametrize("compiled", [True, False])
def test_levels_with_too_many_nodes_are_named(compiled, kernels):
    points = in_order(clouds()["random"][0][:300])
    data, head = Octree().encode(points, 16), len(write_varint(300))
    kernels(compiled)
    fewer = data[:2] + write_varint(200) * 2 + data[2 + 2 * head :]
    with pytest.raises(BitstreamError, match="level 2 has more nodes than the 200 points"):
        Octree().decode(fewer)


def test_claims_of_huge_counts_are_refused():
    points = np.full((70, 3), 5)
    with pytest.raises(BitstreamError, match="at most 60"):
        Octree(max_points=60).decode(Octree().encode(points, 8))
    with pytest.raises(SplatwizardError, match="more than a reader accepts"):
        Octree(max_points=60).encode(points, 8)
    data = Octree().encode(points, 8)
    at = 2  # where the count stands
    assert data[at] == 70
    with pytest.raises(BitstreamError):
        Octree().decode(data[:at] + write_varint(2**40) + data[at + 1 :])


def test_a_few_bytes_never_stand_for_many_points():
    with pytest.raises(SplatwizardError, match="more than a reader accepts"):
        Octree().encode(np.full((100_000, 3), 5), 8)


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=60))
def test_random_bytes_are_refused(data):
    for each in (data, bytes([1, 16]) + data):
        with pytest.raises(BitstreamError):
            Octree().decode(each)
