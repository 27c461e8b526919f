"""Splits: which views are tested."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from sw_datasets.splits import split_views

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
