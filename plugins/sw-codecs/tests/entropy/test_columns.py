"""Entropy model `columns`: any integer matrix comes back; size, estimate, damage, hostile claims."""

import zlib

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from splatwizard_core.errors import BitstreamError
from sw_codecs.entropy import columns as columns_module
from sw_codecs.entropy.column_plan import CONSTANT, ColumnPlan, choose_plan
from sw_codecs.entropy.columns import Columns

LIMIT = 2**60


def round_trip(matrix):
    data = Columns().encode(matrix)
    found = Columns().decode(data, matrix.shape)
    assert found.dtype == np.int64
    assert found.shape == matrix.shape
    assert np.array_equal(found, matrix)
    return data


@settings(max_examples=120, deadline=None)
@given(
    hnp.arrays(
        np.int64,
        hnp.array_shapes(min_dims=1, max_dims=2, min_side=0, max_side=12),
        elements=st.integers(-3, 3) | st.integers(-1000, 1000) | st.integers(-LIMIT, LIMIT),
    )
)
def test_any_matrix_comes_back(matrix):
    round_trip(matrix)


def many_kinds(n, seed=0):
    r = np.random.default_rng(seed)
    return np.stack(
        [
            np.full(n, -7),
            r.integers(0, 2, n),
            np.rint(r.normal(0, 20, n)),
            r.integers(0, 1 << 16, n),
            np.rint(r.normal(30_000, 3000, n)),
            np.rint(r.standard_cauchy(n) * 100).clip(-1e9, 1e9),
            np.cumsum(r.integers(-3, 4, n)),
            r.integers(-LIMIT, LIMIT, n),
            np.sort(r.integers(0, 1 << 40, n)),
            r.choice([3, 70_000], n),
        ],
        1,
    ).astype(np.int64)


@pytest.mark.parametrize("n", [1, 2, 3, 100, 5000])
def test_every_kind_of_column(n):
    round_trip(many_kinds(n))


def test_the_largest_values():
    round_trip(np.array([[LIMIT, -LIMIT], [-LIMIT, LIMIT], [LIMIT, 0]]))
    with pytest.raises(ValueError, match="beyond"):
        Columns().encode(np.array([LIMIT + 1]))


@pytest.mark.parametrize("dtype", ["u1", "i2", "u4", "i8"])
def test_any_integer_dtype_and_a_single_axis(dtype):
    values = np.arange(100).astype(dtype)
    assert np.array_equal(Columns().decode(Columns().encode(values), (100,)), values)
    with pytest.raises(ValueError, match="integers"):
        Columns().encode(np.zeros((3, 2)))


def test_size_agrees_with_the_estimate():
    matrix = many_kinds(100_000)
    estimate = float(Columns().bits(torch.from_numpy(matrix)).sum())
    assert 8 * len(round_trip(matrix)) == pytest.approx(estimate, rel=0.005)


def test_tables_of_a_small_matrix_do_not_eat_the_gain():
    # 45 columns of 2,000 Gaussian symbols: the tables and plans may add 2 % to the empirical cost.
    matrix = np.rint(np.random.default_rng(1).normal(0, 20, (2000, 45))).astype(int)
    ideal = 2000 * 45 * (0.5 * np.log2(2 * np.pi * np.e * 20**2))
    assert 8 * len(Columns().encode(matrix)) < 1.02 * ideal


@pytest.mark.parametrize(
    ("column", "ideal_bits"),
    [
        (lambda r, n: r.integers(0, 1 << 16, n), 16.0),
        (lambda r, n: r.choice([5, 60_000], n), 1.0),
        (lambda r, n: np.cumsum(r.integers(0, 8, n)), 3.0),
        (lambda r, n: np.full(n, 123_456), 0.0),
        (lambda r, n: np.rint(r.laplace(0, 5000, n)).astype(int), np.log2(2 * np.e * 5000)),
    ],
)
def test_wide_alphabets_do_not_cost_more_than_they_save(column, ideal_bits):
    n = 50_000
    data = Columns().encode(column(np.random.default_rng(2), n))
    assert 8 * len(data) / n < ideal_bits * 1.01 + 0.02


def test_many_chunks(monkeypatch):
    monkeypatch.setattr(columns_module, "CHUNK", 700)
    round_trip(many_kinds(2500))
    round_trip(many_kinds(300))


def test_damage_is_found(assert_survives_damage):
    matrix = many_kinds(40)[:, [0, 1, 2, 5, 6]]
    data = Columns().encode(matrix)
    assert_survives_damage(data, lambda d: Columns().decode(d, matrix.shape), matrix)


def test_the_crc_of_every_chunk_is_checked(monkeypatch):
    monkeypatch.setattr(columns_module, "CHUNK", 20)
    values = np.random.default_rng(0).integers(0, 7, 50)
    plan = choose_plan(values)
    classes = plan.split(plan.residuals(values))[0]
    data = Columns().encode(values)
    for start in (0, 20, 40):
        crc = zlib.crc32(classes[start : start + 20].astype("<i4")).to_bytes(4, "little")
        assert data.count(crc) == 1
        with pytest.raises(BitstreamError, match="CRC-32"):
            Columns().decode(data.replace(crc, b"none"), (50,))


@pytest.mark.parametrize("plan", [ColumnPlan(CONSTANT, 2 * LIMIT), ColumnPlan(CONSTANT, LIMIT, first=LIMIT)])
def test_decoded_values_keep_to_the_documented_range(plan):
    values = plan.values(np.full(20, plan.offset))
    crc = zlib.crc32(values.astype("<i8"))
    head = bytes([1]) + (20).to_bytes(4, "little") + (1).to_bytes(2, "little") + crc.to_bytes(4, "little")
    with pytest.raises(BitstreamError, match="beyond 2"):
        Columns().decode(head + plan.pack() + b"\x00", (20,))


def test_a_shape_that_the_caller_does_not_expect_is_refused_before_memory_is_taken():
    data = Columns().encode(np.zeros((5, 2), int))
    huge = data[:1] + (2**32 - 1).to_bytes(4, "little") + (2**16 - 1).to_bytes(2, "little") + data[7:]
    with pytest.raises(BitstreamError, match="expected 5 x 2"):
        Columns().decode(huge, (5, 2))
    with pytest.raises(BitstreamError):
        Columns().decode(huge, (2**32 - 1, 2**16 - 1))


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=80))
def test_random_bytes_are_refused(data):
    head = bytes([1, 9, 0, 0, 0, 2, 0])
    for each in (data, head + data):
        with pytest.raises(BitstreamError):
            Columns().decode(each, (9, 2))
