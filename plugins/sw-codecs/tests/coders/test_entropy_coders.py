"""range, rans and huffman under every model: round trips, sizes against the entropy, damage."""

import constriction
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from splatwizard_core.errors import BitstreamError
from splatwizard_core.plugins import load_plugins
from sw_codecs.coders import arithmetic as coders
from sw_codecs.coders.arithmetic import RangeCoder, RansCoder
from sw_codecs.coders.huffman import HuffmanCoder
from sw_codecs.coders.model_spec import Bernoulli, Gaussian, Laplace, Table, Tables, Uniform
from sw_codecs.coders.symbol_stream import guarded

CODERS = [RangeCoder, RansCoder, HuffmanCoder]
STREAMS = [RangeCoder, RansCoder]
N = 100_000


def rng(seed=0):
    return np.random.default_rng(seed)


def models(n, seed=1):
    """A model of each kind with symbols that it may well produce."""
    r = rng(seed)
    mu, sigma = r.normal(0, 30, n), np.exp(r.uniform(-2, 3, n))
    counts, index = r.integers(0, 50, (5, 17)), r.integers(0, 5, n)
    counts[:, 3] += 1
    p = r.uniform(0, 1, n)
    return {
        "gaussian": (np.rint(r.normal(mu, sigma)), Gaussian(mu, sigma, -2000, 2000)),
        "gaussian-shared": (np.rint(r.normal(2.3, 4, n)), Gaussian(2.3, 4.0, -100, 100)),
        "laplace": (np.rint(r.laplace(mu, sigma)), Laplace(mu, sigma, -3000, 3000)),
        "laplace-one-scale": (np.rint(r.laplace(mu, 2.0)), Laplace(mu, 2.0, -3000, 3000)),
        "table": (r.choice(17, n, p=counts[0] / counts[0].sum()), Table(counts[0])),
        "tables": ((r.random(n)[:, None] > (counts / counts.sum(1, keepdims=True)).cumsum(1)[index]).sum(1).clip(0, 16),
                   Tables(counts, index)),
        "bernoulli": (r.random(n) < p, Bernoulli(p)),
        "bernoulli-shared": (r.random(n) < 0.1, Bernoulli(0.1)),
        "uniform": (r.integers(0, 1000, n), Uniform(1000)),
    }  # fmt: skip


@pytest.mark.parametrize("name", ["range", "rans", "huffman"])
def test_a_package_that_imports_nothing_of_ours_builds_a_model(name):
    coder = load_plugins().coders.load(name)
    model = coder.specs.Table(np.array([1, 2, 5]))
    symbols = np.array([2, 2, 0, 1, 2], np.int32)
    assert np.array_equal(coder().decode(coder().encode(symbols, model), 5, model), symbols)


@pytest.mark.parametrize("coder", STREAMS)
@pytest.mark.parametrize("name", list(models(0)))
@pytest.mark.parametrize("n", [0, 1, 2, 3000])
def test_round_trip(coder, name, n):
    symbols, spec = models(n)[name]
    symbols = symbols.astype(np.int32)
    data = coder().encode(symbols, spec)
    found = coder().decode(data, n, spec)
    assert found.dtype == np.int32
    assert np.array_equal(found, symbols)
    assert (n > 0) == (len(data) > 0)


@pytest.mark.parametrize("name", ["table", "tables", "gaussian-shared"])
def test_huffman_round_trip(name):
    symbols, spec = models(3000)[name]
    data = HuffmanCoder().encode(symbols.astype(int), spec)
    assert np.array_equal(HuffmanCoder().decode(data, 3000, spec), symbols)


@pytest.mark.parametrize(("family", "spec"), [(stats.norm, Gaussian), (stats.laplace, Laplace)])
def test_huffman_turns_densities_into_tables(family, spec):
    mu = np.array([-3.0, 0.0, 2.5])[rng().integers(0, 3, 5000)]
    symbols = np.rint(family.rvs(mu, 3.0, random_state=rng(1))).astype(int)
    model = spec(mu, 3.0, -60, 60)
    data = HuffmanCoder().encode(symbols, model)
    assert np.array_equal(HuffmanCoder().decode(data, 5000, model), symbols)
    bits = -np.log2(family.cdf(symbols + 0.5, mu, 3.0) - family.cdf(symbols - 0.5, mu, 3.0)).sum()
    # A Huffman code is within a bit of the entropy, for these smooth models within 0.1.
    assert bits - 500 < 8 * len(data) < bits + 500 + 8 * 24


def test_huffman_bits_are_those_of_the_library_one_symbol_at_a_time():
    r = rng(7)
    fibonacci = [1, 1]
    while len(fibonacci) < 72:  # codes of up to 71 bits: longer than a machine word
        fibonacci.append(sum(fibonacci[-2:]))
    for counts, n in ((np.exp(r.uniform(0, 20, (5, 30))).astype(int), 2000), (np.array([fibonacci]), 300)):
        index, symbols = r.integers(0, len(counts), n), r.integers(0, counts.shape[1], n)
        spec = Tables(counts, index)
        trees = [constriction.symbol.huffman.EncoderHuffmanTree(row.astype(np.float32)) for row in counts]
        encoder = constriction.symbol.QueueEncoder()
        for symbol, table in zip(symbols, index, strict=True):
            encoder.encode_symbol(int(symbol), trees[table])
        data = HuffmanCoder().encode(symbols, spec)
        assert data[coders.HEADER.size :] == encoder.get_compressed_and_bitrate()[0].astype("<u4").tobytes()
        assert np.array_equal(HuffmanCoder().decode(data, n, spec), symbols)


def test_huffman_refuses_what_has_no_table():
    with pytest.raises(ValueError, match="takes tables, not Bernoulli"):
        HuffmanCoder().encode(np.array([0, 1]), Bernoulli(0.5))
    mu = np.arange(5000.0)
    with pytest.raises(ValueError, match="too many for Huffman"):
        HuffmanCoder().encode(np.arange(5000) % 7, Gaussian(mu, 1.0, 0, 6))


@settings(max_examples=60, deadline=None)
@given(st.sampled_from(CODERS), st.data())
def test_any_table_codes_any_symbols(coder, data):
    counts = data.draw(st.lists(st.integers(0, 2**40), min_size=1, max_size=12).filter(any))
    possible = [i for i, c in enumerate(counts) if c or sum(map(bool, counts)) > 1]
    symbols = np.array(data.draw(st.lists(st.sampled_from(possible), max_size=30)), np.int32)
    spec = Table(np.array(counts))
    assert np.array_equal(coder().decode(coder().encode(symbols, spec), len(symbols), spec), symbols)


@pytest.mark.parametrize("coder", CODERS)
@pytest.mark.parametrize("n", [1, 500])
def test_constant_symbols_take_a_chunk_header_only(coder, n):
    for spec, value in (
        (Table(np.array([3, 4, 5])), 2),
        (Gaussian(0.0, 1.0, -5, 5), -1),
        (Gaussian(1.0, 1.0, 7, 7), 7),
    ):
        symbols = np.full(n, value)
        data = coder().encode(symbols, spec)
        assert len(data) == 20
        assert np.array_equal(coder().decode(data, n, spec), symbols)


@pytest.mark.parametrize("coder", STREAMS)
def test_mean_far_outside_the_domain_still_codes(coder):
    symbols = np.array([-5, 5, 0, 3])
    for spec in (Gaussian(np.full(4, 1e6), 0.5, -5, 5), Laplace(np.full(4, -1e6), 0.5, -5, 5)):
        assert np.array_equal(coder().decode(coder().encode(symbols, spec), 4, spec), symbols)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("coder", CODERS)
@pytest.mark.parametrize("spec", [Gaussian, Laplace])
def test_the_smallest_and_largest_parameters_still_code(coder, spec):
    symbols = np.array([-5, 4, 0, 1, 0, 2, -1])
    for location in (0.0, 1e300, -1e300, 0.5):
        for scale in (5e-324, 1e-300, 1e20, 1e300):
            for model in (spec(location, scale, -6, 6), spec(np.full(7, location), np.full(7, scale), -6, 6)):
                assert np.array_equal(coder().decode(coder().encode(symbols, model), 7, model), symbols)


def test_bits_decode_with_and_without_the_kernel(kernels):
    shares = np.concatenate([rng(3).random(40), [1e-9, 2.0**-24, 3e-5, 0.5, 1 / 3, 1 - 1e-6, 1 - 1e-9]])
    coded = []
    kernels(False)
    for share in shares:
        symbols = (rng(4).random(400) < np.clip(share, 0.02, 0.98)).astype(int)
        coded.append((symbols, Bernoulli(float(share)), RangeCoder().encode(symbols, Bernoulli(float(share)))))
    kernels(True)
    for symbols, model, data in coded:
        assert np.array_equal(RangeCoder().decode(data, len(symbols), model), symbols)
    with pytest.raises(BitstreamError):
        RangeCoder().decode(data[:20] + b"\xff" * (len(data) - 20), len(symbols), model)


@pytest.mark.parametrize("coder", STREAMS)
@pytest.mark.parametrize("name", ["table", "gaussian", "bernoulli"])
def test_many_chunks(coder, name, monkeypatch):
    monkeypatch.setattr(coders, "CHUNK", 1000)
    symbols, spec = models(3500)[name]
    data = coder().encode(symbols.astype(int), spec)
    assert np.array_equal(coder().decode(data, 3500, spec), symbols)
    with pytest.raises(BitstreamError, match="1,000 symbols, expected 400"):
        coder().decode(data, 400, spec.part(0, 400))


@pytest.mark.parametrize("coder", CODERS)
def test_more_symbols_than_the_bytes_can_hold_take_no_memory(coder):
    data = coder().encode(np.zeros(5, int), Table(np.ones(3, int)))
    with pytest.raises(BitstreamError, match="cannot hold"):
        coder().decode(data, 1 << 50, Table(np.ones(3, int)))


@pytest.mark.parametrize("coder", CODERS)
def test_a_chunk_under_a_float_model_that_does_not_decode_is_not_written(coder, monkeypatch):
    monkeypatch.setattr(coder, "_decode_chunk", lambda self, payload, count, spec: np.zeros(count, np.int32))
    with pytest.raises(RuntimeError, match="does not decode"):
        coder().encode(np.array([0, 1, 2]), Gaussian(0.0, 1.0, -5, 5))
    assert coder(verify=False).encode(np.array([0, 1, 2]), Gaussian(0.0, 1.0, -5, 5))


@pytest.mark.parametrize("coder", STREAMS)
@pytest.mark.parametrize("scale", [0.2, 1.0, 20.0])
def test_size_is_the_entropy_of_the_model(coder, scale):
    mu = rng(3).normal(0, 10, N)
    for family, spec in ((stats.norm, Gaussian), (stats.laplace, Laplace)):
        k = np.rint(family.rvs(mu, scale, random_state=rng(4)))
        bits = -np.log2(family.cdf(k + 0.5, mu, scale) - family.cdf(k - 0.5, mu, scale)).sum()
        size = 8 * len(coder().encode(k.astype(int), spec(mu, scale, int(k.min()), int(k.max()))))
        assert size == pytest.approx(bits, rel=0.005)


@pytest.mark.parametrize("coder", CODERS)
def test_table_size_is_its_entropy(coder):
    counts = np.array([500, 300, 100, 60, 30, 10])
    p = counts / counts.sum()
    symbols = rng(5).choice(6, N, p=p)
    size = 8 * len(coder().encode(symbols, Table(counts)))
    entropy = -np.log2(p[symbols]).sum()
    if coder is HuffmanCoder:
        # Lengths 1, 2, 3, 4, 5, 5: the optimal code, worked out by hand.
        assert size == pytest.approx(np.array([1, 2, 3, 4, 5, 5])[symbols].sum(), abs=8 * 24)
        assert entropy <= size < entropy + N
    else:
        assert size == pytest.approx(entropy, rel=0.005)


@pytest.mark.parametrize("coder", CODERS)
def test_damage_is_found(assert_survives_damage, coder):
    symbols, spec = models(60)["tables"]
    data = coder().encode(symbols, spec)
    assert_survives_damage(data, lambda d: coder().decode(d, 60, spec), symbols)


@pytest.mark.parametrize("coder", STREAMS)
def test_the_last_bit_of_one_parameter_is_caught_by_the_crc(coder):
    r = rng(6)
    mu = r.normal(0, 5, 2000)
    symbols = np.rint(r.normal(mu, 1.0)).astype(int)
    data = coder().encode(symbols, Gaussian(mu, 1.0, -50, 50))
    other = mu.copy()
    other[3] += 0.25
    with pytest.raises(BitstreamError, match="CRC-32"):
        coder().decode(data, 2000, Gaussian(other, 1.0, -50, 50))


@pytest.mark.parametrize(
    "make",
    [
        lambda: Gaussian(np.nan, 1.0, 0, 5),
        lambda: Gaussian(0.0, 0.0, 0, 5),
        lambda: Gaussian(0.0, np.inf, 0, 5),
        lambda: Gaussian(0.0, -1.0, 0, 5),
        lambda: Laplace(np.array([0.0, np.inf]), 1.0, 0, 5),
        lambda: Gaussian(0.0, 1.0, 5, 4),
        lambda: Gaussian(0.0, 1.0, 0, 1 << 24),
        lambda: Table(np.array([0, 0])),
        lambda: Table(np.array([1.0, 2.0])),
        lambda: Table(np.array([-1, 2])),
        lambda: Table(np.array([], int)),
        lambda: Tables(np.array([[1, 1]]), np.array([1])),
        lambda: Bernoulli(1.5),
        lambda: Bernoulli(np.nan),
        lambda: Uniform(0),
        lambda: Uniform(1 << 24),
    ],
)
def test_models_that_make_no_sense_are_refused(make):
    with pytest.raises(ValueError):
        make()


def test_a_panic_of_the_library_becomes_an_ordinary_error():
    # It derives from BaseException, so that `except Exception` would miss it.
    for error in (ValueError, BitstreamError):
        with pytest.raises(error, match="coding failed"), guarded(error, "coding"):
            constriction.stream.model.QuantizedGaussian(0, 5, 0.0, 0.0)
    with pytest.raises(KeyboardInterrupt), guarded(ValueError, "coding"):
        raise KeyboardInterrupt


@pytest.mark.parametrize("coder", CODERS)
def test_symbols_outside_the_model_are_refused(coder):
    for symbols in (np.array([3]), np.array([-1]), np.array([0.5]), np.array([[0]])):
        with pytest.raises(ValueError):
            coder().encode(symbols, Table(np.array([1, 1, 1])))
    with pytest.raises(ValueError, match="leave the model"):  # not cut off to 32 bits
        coder().encode(np.array([1 << 32]), Table(np.array([1, 1, 1])))
    with pytest.raises(ValueError, match="2 values"):
        coder().encode(np.zeros(3, int), Tables(np.array([[1, 1]]), np.array([0, 0])))
