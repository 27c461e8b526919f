"""Classes of activity: both sides agree on them, and they pay where magnitudes go together."""

import numpy as np
import pytest

from splatwizard_core.errors import BitstreamError
from splatwizard_core.plugins import load_plugins
from sw_codecs.models.band_context import activity_classes, decode_band, encode_band, suitable_classes


def by_class(symbols, classes, count):
    return [symbols[classes == k] for k in range(count)]


@pytest.fixture(scope="module")
def columns():
    return load_plugins().entropy_models.load("columns")()


@pytest.mark.parametrize(("rows", "classes"), [(0, 1), (4095, 1), (4096, 2), (8192, 4), (16_384, 8), (10**7, 8)])
def test_classes_must_repay_their_tables(rows, classes):
    assert suitable_classes(rows) == classes


def test_classes_are_quantiles_of_the_summed_magnitudes():
    lower = np.array([[0, 0], [-3, 1], [0, 1], [5, -5], [0, 0], [2, 0], [0, -7], [1, 1]])
    # sums 0 4 1 10 0 2 7 2, sorted 0 0 1 2 2 4 7 10: limits 1, 2, 7
    assert activity_classes(lower, 4).tolist() == [0, 2, 1, 3, 0, 2, 3, 2]
    assert not activity_classes(lower, 1).any()


@pytest.mark.parametrize("count", [1, 4, 16])
@pytest.mark.parametrize("rows", [0, 1, 3, 200])
def test_round_trip(columns, rows, count):
    rng = np.random.default_rng(0)
    symbols, lower = rng.integers(-9, 9, (rows, 6)), rng.integers(-2, 2, (rows, 3))
    classes = activity_classes(lower, count)
    data = encode_band(columns, by_class(symbols, classes, count))
    assert np.array_equal(decode_band(columns, data, classes, count, 6), symbols)


def test_magnitudes_that_go_together_cost_less_in_classes(columns):
    rng = np.random.default_rng(0)
    scale = np.exp(rng.normal(size=(16_384, 1)) * 1.5)
    lower, symbols = (np.rint(rng.laplace(size=(16_384, 9)) * scale).astype(np.int64) for _ in range(2))
    sizes = [len(encode_band(columns, by_class(symbols, activity_classes(lower, k), k))) for k in (1, 8)]
    assert sizes[1] < 0.9 * sizes[0]


@pytest.mark.parametrize("spoil", [lambda d: d[:3], lambda d: d[:-1], lambda d: d + b"x", lambda d: bytes(8) + d[8:]])
def test_lengths_that_do_not_fit_are_refused(columns, spoil):
    symbols = np.arange(40).reshape(20, 2)
    classes = np.arange(20) % 2
    with pytest.raises(BitstreamError):
        decode_band(columns, spoil(encode_band(columns, by_class(symbols, classes, 2))), classes, 2, 2)


def test_bytes_for_an_empty_class_are_refused(columns):
    symbols, classes = np.arange(8).reshape(4, 2), np.array([0, 0, 1, 1])
    data = encode_band(columns, by_class(symbols, classes, 2))
    with pytest.raises(BitstreamError, match="class 0 has 0 rows"):
        decode_band(columns, data, np.ones(4, np.int64), 2, 2)
