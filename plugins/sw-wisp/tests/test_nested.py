import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import norm

from splatwizard_core.api import BitstreamError
from sw_codecs import testing
from sw_codecs.entropy.exact_tables import exact_tables
from sw_wisp import nested
from sw_wisp.nested_model import NestedGaussian


def normal_indices(ratio: float, n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Indices of a centred Gaussian of `ratio` steps, and their tables."""
    levels = np.log(ratio / 0.05) / np.log(1280) * 63
    scales = np.full(n, round(4096 * min(max(levels, 0), 63)))
    return np.rint(np.random.default_rng(seed).normal(0, ratio, n)).astype(np.int64), scales


def coded(*calls) -> bytes:
    writer = nested.Writer()
    for call in calls:
        call(writer)
    return writer.finish()


@pytest.mark.parametrize("ratio", [0.05, 0.3, 1, 5, 64])
def test_coarse_index_and_trit_give_the_index(ratio):
    k, scales = normal_indices(ratio, 20_000)
    k[::1000] = np.random.default_rng(1).integers(-(10**4), 10**4, 20)
    fine, coarse = nested.table_levels(scales), nested.table_levels(scales, 1)
    c = nested.coarser(k)
    data = coded(lambda w: w.indices(coarse, c), lambda w: w.trits(fine, c, k - 3 * c))
    reader = nested.Reader(data)
    again = reader.indices(coarse, None)
    assert np.array_equal(3 * again + reader.trits(fine, again, None), k)
    reader.finish()


@pytest.mark.parametrize("ratio", [0.3, 0.5, 0.8, 1.3, 2.5, 5])
def test_nesting_costs_next_to_nothing(ratio):
    k, scales = normal_indices(ratio, 400_000)
    fine, coarse = nested.table_levels(scales), nested.table_levels(scales, 1)
    c = nested.coarser(k)
    whole, parts = nested.Counter(), nested.Counter()
    whole.indices(fine, k)
    parts.indices(coarse, c)
    parts.trits(fine, c, k - 3 * c)
    assert parts.total <= 1.002 * whole.total


@pytest.mark.parametrize(("ratio", "bits", "coarse_bits"), [(0.3, 0.55, 0.0), (0.8, 1.81, 0.39), (2.5, 3.38, 1.87)])
def test_bits_are_those_of_a_centred_gaussian(ratio, bits, coarse_bits):
    k, scales = normal_indices(ratio, 400_000)
    edges = norm.cdf(np.arange(-60.5, 61), scale=ratio)
    share = np.diff(edges)
    ideal = -(share[share > 0] * np.log2(share[share > 0])).sum()
    assert ideal == pytest.approx(bits, abs=0.01)
    assert nested.index_bits(nested.table_levels(scales), k).mean() == pytest.approx(ideal, abs=0.01)
    coarse = nested.index_bits(nested.table_levels(scales, 1), nested.coarser(k)).mean()
    assert coarse == pytest.approx(coarse_bits, abs=0.01)


@pytest.mark.parametrize("level", [0, 20, 63])
def test_escapes_return(level):
    radius = int(exact_tables().gaussian.radius[level])
    for case in (
        [radius + 1, -radius - 1],
        [10**4, -(10**4), 0],
        [1 << 20, -(1 << 20)],
        [0, radius + 5, 1, -radius - 9],
    ):
        k = np.array(case)
        tables = np.full(len(k), level, np.uint8)
        reader = nested.Reader(coded(lambda w, t=tables, k=k: w.indices(t, k)))
        assert np.array_equal(reader.indices(tables, None), k)
        reader.finish()


@given(st.lists(st.tuples(st.integers(0, 63), st.integers(-(2**21) + 1, 2**21 - 1)), max_size=40))
def test_any_indices_under_any_tables_return(pairs):
    tables = np.array([level for level, _ in pairs], np.uint8)
    k = np.array([index for _, index in pairs], np.int64)
    data = coded(lambda w: w.indices(tables, k))
    assert np.array_equal(nested.Reader(data).indices(tables, None), k)
    counter = nested.Counter()
    counter.indices(tables, k)
    assert nested.index_bits(tables, k).sum() == pytest.approx(counter.total)


def test_estimate_is_the_size_of_the_file():
    rng = np.random.default_rng(5)
    scales = rng.integers(0, 64 << 12, 30_000)
    tables = nested.table_levels(scales)
    k = np.rint(rng.standard_t(3, 30_000) * exact_tables().scales[tables]).astype(np.int64)
    size = 8 * len(coded(lambda w: w.indices(tables, k)))
    assert nested.index_bits(tables, k).sum() == pytest.approx(size, rel=0.001)


def test_an_index_beyond_the_limit_is_refused():
    with pytest.raises(ValueError, match="beyond"):
        nested.Writer().indices(np.zeros(1, np.uint8), np.array([1 << 21]))


def test_damaged_bytes_end_in_a_bitstream_error_or_other_symbols():
    _, scales = normal_indices(0.05, 300)
    tables = nested.table_levels(scales)
    rng = np.random.default_rng(0)
    for _ in range(300):
        reader = nested.Reader(rng.integers(0, 256, 64, np.uint8).tobytes())
        try:
            found = reader.indices(tables, None)
            assert np.abs(found).max() < nested.INDEX_LIMIT
        except BitstreamError:
            pass


def test_no_symbols_are_no_bytes():
    assert nested.Writer().finish() == b""
    nested.Reader(b"").finish()
    with pytest.raises(BitstreamError, match="no bytes"):
        nested.Reader(b"").indices(np.zeros(1, np.uint8), None)
    with pytest.raises(BitstreamError, match="left"):
        nested.Reader(b"abcd").finish()


def case(n: int) -> testing.EntropyCase:
    draws = np.random.default_rng(0)
    levels = draws.uniform(5, 60, (n + 4) // 5 * 5).reshape(-1, 5)
    symbols = np.rint(draws.normal(0, 0.05 * 1280 ** (levels / 63))).astype(np.int64)
    scales = np.rint(4096 * levels).astype(np.int64)
    return testing.EntropyCase(symbols, scales, torch.from_numpy(levels), scales)


def test_the_entropy_model_keeps_its_contract():
    testing.check_entropy_model(NestedGaussian, case)
