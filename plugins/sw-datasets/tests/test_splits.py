"""Splits: which views are tested."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from ring_views import ring
from sw_datasets.splits import holds_out_places, is_rule, sparse_indices, split_scene, split_views

from splatwizard_core.errors import SceneError


def test_every8_over_25_names_tests_0_8_16_24():
    train, test = split_views(range(25), "every8")
    assert test == [0, 8, 16, 24]
    assert train == [i for i in range(25) if i % 8]


def test_lod30_over_100_tests_the_first_31():
    train, test = split_views(range(100), "lod:30")
    assert test == list(range(31))
    assert train == list(range(31, 100))


def test_lod_from_50_on_is_the_other_way_round():
    train, test = split_views(range(100), "lod:50")
    assert train == list(range(51))
    assert test == list(range(51, 100))


def test_all_trains_and_tests_everything():
    assert split_views(range(3), "all") == ([0, 1, 2], [0, 1, 2])


@given(st.integers(2, 200), st.integers(2, 20))
def test_every_n_is_a_partition(count, n):
    train, test = split_views(range(count), f"every{n}")
    assert sorted(train + test) == list(range(count))
    assert len(test) == -(-count // n)


@pytest.mark.parametrize("rule", ["every", "every-1", "lod", "lod:x", "some", "", "every8 ", "every99999999999"])
def test_an_unknown_rule_is_refused_with_what_there_is(rule):
    with pytest.raises(SceneError, match=r"unknown split .*'every<n>'"):
        split_views(range(10), rule)


@pytest.mark.parametrize(("count", "rule"), [(1, "every8"), (20, "lod:30"), (20, "lod:60"), (0, "all"), (4, "every1")])
def test_an_empty_half_is_refused(count, rule):
    with pytest.raises(SceneError):
        split_views(range(count), rule)


@pytest.mark.parametrize(("n", "trained"), [
    (3, [0, 10, 20]), (6, [0, 4, 8, 12, 16, 20]), (12, [0, 2, 4, 5, 7, 9, 11, 13, 15, 16, 18, 20]), (1, [10]),
])  # fmt: skip
def test_sparse_trains_on_n_evenly_spaced_ones(n, trained):
    others = [i for i in range(24) if i % 8]
    assert len(others) == 21
    train, test = split_views(range(24), f"sparse:{n}")
    assert train == [others[i] for i in trained]
    assert test == [0, 8, 16]


def test_sparse_of_100_takes_the_nearest_indices():
    assert sparse_indices(100, "sparse:9") == [0, 12, 25, 37, 50, 62, 74, 87, 99]


@given(st.integers(2, 300), st.integers(1, 299))
def test_sparse_indices_are_distinct_and_reach_both_ends(count, n):
    found = sparse_indices(count, f"sparse:{min(n, count)}")
    assert found == sorted(set(found))
    assert len(found) == min(n, count)
    if len(found) > 1:
        assert (found[0], found[-1]) == (0, count - 1)


@given(st.integers(2, 100), st.integers(2, 12))
def test_the_blocks_are_a_partition_of_consecutive_runs(count, n):
    runs = []
    for k in range(n):
        try:
            train, test = split_views(range(count), f"block:{k}of{n}")
        except SceneError:  # fewer views than blocks: some are empty
            assert count < n
            continue
        assert sorted(train + test) == list(range(count))
        runs += test
    assert runs == list(range(count))


@pytest.mark.parametrize("rule", ["sparse:0", "sparse:22", "block:2of2", "block:0of1", "file+sparse:3", "file+every8"])
def test_what_cannot_be_split_so_is_refused(rule):
    with pytest.raises(SceneError, match="split '"):
        split_scene(ring(24), rule)


def test_what_is_a_rule_and_what_holds_out_places():
    for rule in ("sparse:9", "sector:60", "sector:60@120", "block:0of4", "file+sector:90@10"):
        assert is_rule(rule)
        assert holds_out_places(rule)
    assert is_rule("every8")
    assert not holds_out_places("every8")
    assert not is_rule("sector")
