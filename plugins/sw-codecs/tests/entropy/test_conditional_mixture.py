"""Rows under mixtures of two predicted Gaussians: exact on any machine, or in floats on this one."""

import contextlib
import dataclasses
import types

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from splatwizard_core.errors import BitstreamError
from sw_codecs.entropy import conditional_mixture
from sw_codecs.entropy.conditional import ConditionalGaussian
from sw_codecs.entropy.conditional_mixture import WIDTHS, ConditionalMixture
from sw_codecs.entropy.further_rates import mixture_bits

C = ConditionalMixture


@contextlib.contextmanager
def without_kernel():
    """The library constriction in place of the compiled kernel."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(conditional_mixture, "EXACT", types.SimpleNamespace(try_load=lambda: False))
        yield


def parameters(n, columns, seed=0):
    """Mean, scale, second mean and scale, logit, step; and symbols that follow them."""
    rng = np.random.default_rng(seed)
    shape = (n, columns)
    step = rng.uniform(0.1, 1.9, (n, 1))
    scale, second_scale = (np.exp(rng.normal(center, 0.5, shape)) for center in (0.3, -0.2))
    mean = rng.normal(0, 20, shape)
    second_mean, logit = mean + rng.normal(0, 0.8, shape), rng.normal(0, 1.5, shape)
    first = rng.random(shape) < 1 / (1 + np.exp(-logit))
    values = np.where(first, rng.normal(mean, scale), rng.normal(second_mean, second_scale))
    return (mean, scale, second_mean, second_scale, logit, step), np.rint(values / step).astype(np.int64)


def block(n=200, columns=7, seed=0, mode="exact"):
    """The same as a context, with one far outlier among the symbols."""
    found, symbols = parameters(n, columns, seed)
    if symbols.size:
        symbols[0, 0] += 9000
    if mode == "exact":
        found = tuple(np.rint(each * 4096).astype(np.int64) for each in found)
    return symbols, C.Context(*found)


@pytest.mark.parametrize("mode", C.MODES)
@pytest.mark.parametrize("shape", [(200, 7), (1, 1), (0, 7), (5, 0)])
def test_a_block_comes_back(mode, shape):
    symbols, context = block(*shape, mode=mode)
    present = np.random.default_rng(1).random(shape) < 0.6
    assert np.array_equal(C(mode).decode(C(mode).encode(symbols, context), context), symbols)
    data = C(mode).encode(symbols, context, present)
    assert np.array_equal(C(mode).decode(data, context, present), symbols * present)


def test_tensors_are_taken_too():
    symbols, context = block()
    tensors = C.Context(*(torch.from_numpy(getattr(context, f.name)) for f in dataclasses.fields(context)))
    data = C().encode(torch.from_numpy(symbols), tensors)
    assert data == C().encode(symbols, context)
    assert np.array_equal(C().decode(data, tensors), symbols)


@pytest.mark.parametrize(("name", "place"), [("scale", np.s_[:, :1]), ("logit", np.s_[0]), ("logit", np.s_[0, 0])])
def test_parameters_are_spread_over_a_block(name, place):
    symbols, context = block()
    part = getattr(context, name)[place]
    narrow = dataclasses.replace(context, **{name: part})
    full = dataclasses.replace(context, **{name: np.broadcast_to(part, symbols.shape).copy()})
    data = C().encode(symbols, full)
    assert C().encode(symbols, narrow) == data
    assert np.array_equal(C().decode(data, narrow), symbols)


def test_the_size_is_that_of_the_tables_and_close_to_the_ideal():
    found, symbols = parameters(4000, 10)
    context = C.Context(*(np.rint(each * 4096).astype(np.int64) for each in found))
    size = 8 * len(C().encode(symbols, context))
    mean, scale, second_mean, second_scale, logit, step = map(torch.from_numpy, found)
    ideal = mixture_bits(
        torch.from_numpy(symbols * found[5]), torch.stack([logit, 0 * logit], -1), torch.stack([mean, second_mean], -1),
        torch.stack([scale, second_scale], -1), step,
    )  # fmt: skip
    assert size == pytest.approx(float(C().bits(symbols, context).sum()), rel=5e-3)
    assert size == pytest.approx(float(ideal.sum()), rel=0.01)
    assert 8 * len(C("float").encode(symbols, C.Context(*found))) == pytest.approx(float(ideal.sum()), rel=0.01)
    # The heavier Gaussian alone is no substitute.
    heavy = np.where(found[4] > 0, found[0], found[2]), np.where(found[4] > 0, found[1], found[3])
    alone = ConditionalGaussian.Context(*(np.rint(each * 4096).astype(np.int64) for each in (*heavy, found[5])))
    assert float(ConditionalGaussian().bits(symbols, alone).sum()) > 1.02 * size


def test_the_probabilities_are_the_weighted_sum_of_both_tables():
    """Worked out by hand for one number: weights of 8 bits, counts of both tables, one for each entry."""
    tables = conditional_mixture.exact_tables()
    weight = int(tables.multipliers[((4096 >> 1) + (1 << 15)) >> 9] + 16) >> 5  # sigmoid(1) = 0.731
    assert weight == pytest.approx(256 * 0.731, abs=8)
    context = C.Context(*(np.array([[each]]) for each in (0, 4096, 3 * 4096, 2 * 4096, 4096, 4096)))
    levels = [int(np.searchsorted(tables.thresholds, each << 12 >> 12)) for each in (4096, 2 * 4096)]
    counts = [tables.gaussian.counts[8 * level + 4] for level in levels]
    radius = [int(tables.gaussian.radius[level]) for level in levels]
    width = int(WIDTHS[np.searchsorted(WIDTHS, max(radius[0], radius[1] + 3))])
    expected = np.ones(2 * width + 2)
    for table, reach, middle, share in zip(counts, radius, (0, 3), (weight, 256 - weight), strict=True):
        for s in range(-reach, reach + 1):
            if abs(s + middle) <= width:
                expected[s + middle + width] += share * table[s + reach]
        expected[-1] += share * table[-1]
    for symbol in (-2, 0, 3, 4):
        bits = float(C().bits(np.array([[symbol]]), context)[0, 0])
        assert bits == pytest.approx(np.log2(expected.sum() / expected[symbol + width]))


def test_gaussians_that_are_one_cost_what_one_costs():
    symbols, context = block(2000, 5)
    same = dataclasses.replace(context, second_mean=context.mean, second_scale=context.scale)
    alone = ConditionalGaussian.Context(context.mean, context.scale, context.step)
    found, expected = C().bits(symbols, same), ConditionalGaussian().bits(symbols, alone)
    assert float(found.sum()) == pytest.approx(float(expected.sum()), rel=2e-3)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0, 3, 11, 40, 300, 10**4]), st.sampled_from([0.01, 1, 60, 1e4]))
@example(0, 10**4, 0.01)
def test_extreme_parameters_come_back(seed, apart, scale):
    """Means far apart, deviations at both ends, logits of +-20: windows of every width, and escapes."""
    rng = np.random.default_rng(seed)
    shape = (30, 3)
    mean = rng.integers(-(1 << 16), 1 << 16, shape)
    second = mean + rng.integers(-apart, apart + 1, shape) * 4096
    scales = [np.rint(scale * rng.random(shape) * 4096).astype(np.int64) for _ in range(2)]
    context = C.Context(mean, scales[0], second, scales[1], rng.integers(-20, 21, shape) * 4096,
                        rng.integers(64, 16_385, (30, 1)))  # fmt: skip
    symbols = rng.integers(-apart - 3, apart + 4, shape)
    data = C().encode(symbols, context)
    assert np.array_equal(C().decode(data, context), symbols)
    with without_kernel():
        assert C().encode(symbols, context) == data
        assert np.array_equal(C().decode(data, context), symbols)
    assert 8 * len(data) == pytest.approx(float(C().bits(symbols, context).sum()), rel=0.01, abs=8 * 20)


def test_every_width_of_a_window_is_met():
    symbols, context = block(20, 1)
    spikes = np.zeros_like(context.scale)  # tables of radius 2
    for width in WIDTHS.tolist():
        second = context.mean + (width - 2) * context.step
        far = C.Context(context.mean, spikes, second, spikes, context.logit, context.step)
        assert set(C()._rows(far, Ellipsis, symbols.shape).width.tolist()) == {width}
        assert np.array_equal(C().decode(C().encode(symbols, far), far), symbols)


def test_how_many_rows_are_made_at_once_is_no_matter(monkeypatch):
    symbols, context = block()
    data = C().encode(symbols, context)
    monkeypatch.setattr(conditional_mixture, "AT_ONCE", 50)
    with without_kernel():
        assert C().encode(symbols, context) == data
        assert np.array_equal(C().decode(data, context), symbols)


@pytest.mark.parametrize("columns", [1, 10, 130])
@pytest.mark.parametrize("size", [1 << 13, 1 << 40])
def test_the_kernel_makes_the_rows_that_numpy_makes(columns, size):
    r = np.random.default_rng(columns)
    mean, scale, second, widening, logit = (r.integers(-size, size, (50, columns)) for _ in range(5))
    step = r.integers(64 if size < 1 << 20 else 16_000, 16_385, (50, 1))
    second[::3] = mean[::3]
    scale[1::2] = r.integers(0, 1 << 18, (25, columns))
    parts = [mean, scale, second, widening, logit, step]
    ours = conditional_mixture._kernel_rows(parts, mean.shape)
    theirs = conditional_mixture._exact_rows(*(np.broadcast_to(each, mean.shape).reshape(-1) for each in parts))
    for field in ("centre", "width", "order"):
        assert np.array_equal(getattr(ours, field), getattr(theirs, field))
    assert all(np.array_equal(a, b) for a, b in zip(ours.exact, theirs.exact, strict=True))
    assert conditional_mixture._kernel_rows([mean, scale, second, widening, logit, step * 0], mean.shape) is None


def test_the_kernel_and_the_library_write_the_same_words():
    """Many symbols, some of them so improbable that carries run through words of ones."""
    found, symbols = parameters(3000, 10, seed=4)
    context = C.Context(*(np.rint(each * 4096).astype(np.int64) for each in found))
    symbols[::7] += np.random.default_rng(5).integers(-6, 7, symbols[::7].shape)
    data = C().encode(symbols, context)
    with without_kernel():
        assert C().encode(symbols, context) == data
        assert np.array_equal(C().decode(data, context), symbols)
    assert np.array_equal(C().decode(data, context), symbols)


@pytest.mark.parametrize("mode", C.MODES)
@pytest.mark.parametrize("field", ["mean", "second_mean", "second_scale", "logit"])
def test_another_context_is_noticed(mode, field):
    symbols, context = block(mode=mode)
    data = C(mode).encode(symbols, context)
    moved = dataclasses.replace(context, **{field: getattr(context, field) + context.step + context.step})
    with pytest.raises(BitstreamError):
        C(mode).decode(data, moved)


@settings(max_examples=30, deadline=None)
@given(st.sampled_from(C.MODES), st.integers(0, 2**32 - 1), st.integers(1, 255), st.booleans())
def test_damage_is_answered_or_changes_nothing(mode, place, value, cut):
    symbols, context = block(40, 5, mode=mode)
    data = bytearray(C(mode).encode(symbols, context))
    at = place % len(data)
    if cut:
        data = data[:at]
    else:
        data[at] ^= value
    try:
        found = C(mode).decode(bytes(data), context)
    except BitstreamError:
        return
    assert np.array_equal(found, symbols)


def test_wrong_input_is_named():
    symbols, context = block(5, 2)
    with pytest.raises(ValueError, match="beyond 2\\^30"):
        C().encode(symbols + (1 << 30), context)
    with pytest.raises(ValueError, match="integers"):
        C().encode(symbols, dataclasses.replace(context, logit=context.logit / 2.0))
    with pytest.raises(BitstreamError, match="beyond"):
        C().decode(b"", dataclasses.replace(context, mean=context.mean + (1 << 50)))
    floats = block(5, 2, mode="float")[1]
    with pytest.raises(ValueError, match="not finite"):
        C("float").encode(symbols, dataclasses.replace(floats, mean=floats.mean * np.inf))
    with pytest.raises(ValueError, match="mode is 'fast'"):
        C("fast")


@pytest.mark.parametrize("kernel", [True, False])
def test_words_that_do_not_decode_are_noticed_while_encoding(kernel, monkeypatch):
    symbols, context = block()
    rows = conditional_mixture._Rows
    write = rows.encode

    def damaged(self, entries):
        words = bytearray(write(self, entries))
        words[len(words) // 2] ^= 1
        return bytes(words)

    monkeypatch.setattr(rows, "encode", damaged)
    with contextlib.nullcontext() if kernel else without_kernel(), pytest.raises(RuntimeError, match="encoded"):
        C().encode(symbols, context)
