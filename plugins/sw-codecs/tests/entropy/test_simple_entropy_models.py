"""categorical and bernoulli: round trips, estimate against size, damage."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from splatwizard_core.errors import BitstreamError
from sw_codecs.coders.arithmetic import RansCoder
from sw_codecs.coders.huffman import HuffmanCoder
from sw_codecs.entropy.bernoulli import Bernoulli
from sw_codecs.entropy.categorical import Categorical, CategoricalContext

N = 100_000


@settings(max_examples=80, deadline=None)
@given(st.integers(1, 9), st.integers(1, 3), st.data())
def test_categorical_round_trip(size, tables, data):
    rows = data.draw(st.lists(st.tuples(st.integers(0, size - 1), st.integers(0, tables - 1)), max_size=40))
    symbols, index = np.array(rows, np.int64).reshape(-1, 2).T
    context = CategoricalContext(size, index=index, tables=tables)
    assert np.array_equal(Categorical().decode(Categorical().encode(symbols, context), context), symbols)


@pytest.mark.parametrize("coder", [HuffmanCoder, RansCoder])
def test_categorical_with_another_coder(coder):
    symbols = np.minimum(np.random.default_rng(0).geometric(0.3, N) - 1, 63)
    context = CategoricalContext(64, n=N)
    data = Categorical(coder()).encode(symbols, context)
    assert np.array_equal(Categorical(coder()).decode(data, context), symbols)
    bits = float(Categorical().bits(torch.from_numpy(symbols), context).sum())
    assert bits < 8 * len(data) < bits + N
    with pytest.raises(BitstreamError):
        Categorical().decode(data, context)


def test_categorical_estimate_is_the_size():
    r = np.random.default_rng(0)
    index = r.integers(0, 3, N)
    symbols = np.minimum(r.geometric(np.array([0.9, 0.3, 0.05])[index]) - 1, 63)
    for context in (CategoricalContext(64, index=index, tables=3), CategoricalContext(64, n=N)):
        size = 8 * len(Categorical().encode(symbols, context))
        assert size == pytest.approx(float(Categorical().bits(torch.from_numpy(symbols), context).sum()), rel=0.01)


def test_trained_logits_take_the_place_of_counts():
    r = np.random.default_rng(3)
    index = r.integers(0, 2, N)
    symbols = np.minimum(r.geometric(np.array([0.6, 0.2])[index]) - 1, 31)
    logits = torch.zeros(2, 32, requires_grad=True)
    optimizer = torch.optim.Adam([logits], lr=0.5)
    context = CategoricalContext(32, index=index, tables=2, logits=logits)
    for _ in range(40):
        optimizer.zero_grad()
        estimate = Categorical().bits(torch.from_numpy(symbols), context).sum()
        (estimate / N).backward()
        optimizer.step()
    data = Categorical().encode(symbols, context)
    own = Categorical().encode(symbols, CategoricalContext(32, index=index, tables=2))
    assert len(own) < len(data) < 1.02 * len(own)
    assert 8 * len(data) == pytest.approx(float(estimate.detach()), rel=0.01)
    assert np.array_equal(Categorical().decode(data, CategoricalContext(32, index=index, tables=2)), symbols)
    logits.data[0, 3] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        Categorical().encode(symbols, context)
    with pytest.raises(ValueError, match="must be"):
        CategoricalContext(32, tables=2, logits=torch.zeros(32))


def test_a_context_that_tells_something_saves_bytes():
    index = np.arange(3000) % 2
    with_context = Categorical().encode(index * 5, CategoricalContext(8, index=index, tables=2))
    assert len(with_context) < 60 < len(Categorical().encode(index * 5, CategoricalContext(8)))


def test_categorical_damage_is_found(assert_survives_damage):
    symbols = np.random.default_rng(1).integers(0, 5, 60)
    context = CategoricalContext(7, n=60)
    data = Categorical().encode(symbols, context)
    assert_survives_damage(data, lambda d: Categorical().decode(d, context), symbols)


def test_categorical_refuses_what_it_cannot_code():
    for symbols, context in (
        (np.array([7]), CategoricalContext(7)),
        (np.array([-1]), CategoricalContext(7)),
        (np.array([0.0]), CategoricalContext(7)),
        (np.array([0]), CategoricalContext(7, index=np.array([1]), tables=1)),
        (np.array([0]), CategoricalContext(7, index=np.array([0, 0]))),
    ):
        with pytest.raises(ValueError):
            Categorical().encode(symbols, context)
    with pytest.raises(ValueError, match="too many"):
        CategoricalContext(1 << 20, tables=1 << 20)


@given(st.lists(st.booleans(), max_size=60))
def test_bernoulli_round_trip(values):
    mask = np.array(values, bool)
    assert np.array_equal(Bernoulli().decode(Bernoulli().encode(mask), len(mask)), mask)


@pytest.mark.parametrize("share", [0.0, 0.001, 0.1, 0.5, 0.97, 1.0])
def test_bernoulli_estimate_is_the_size(share):
    mask = np.random.default_rng(0).random(N) < share
    data = Bernoulli().encode(mask)
    # A constant mask costs its 24 bytes of chunk header; the clamp of p at 1e-6 adds nothing one could see.
    assert 8 * len(data) == pytest.approx(float(Bernoulli().bits(torch.from_numpy(mask)).sum()), rel=0.02, abs=8 * 32)


def test_bernoulli_damage_is_found(assert_survives_damage):
    mask = np.random.default_rng(2).random(100) < 0.3
    data = Bernoulli().encode(mask)
    assert_survives_damage(data, lambda d: Bernoulli().decode(d, 100), mask)
    with pytest.raises(BitstreamError):
        Bernoulli().decode(data, 99)
    with pytest.raises(ValueError):
        Bernoulli().encode(np.array([0, 1, 2]))
