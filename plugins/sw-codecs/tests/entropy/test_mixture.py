"""mixture: probabilities, round trips, estimate against size, damage, the tables that stand in the file."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from splatwizard_core.errors import BitstreamError
from splatwizard_core.plugins import load_plugins
from sw_codecs.entropy import density_tables, rates
from sw_codecs.entropy.mixture import Mixture, MixtureContext

N = 100_000
FAMILIES = {"gaussian": stats.norm, "laplace": stats.laplace}
numbers = st.integers(-(2**29), 2**29) | st.integers(-30, 30)


def rng(seed=0):
    return np.random.default_rng(seed)


def t(values):
    return torch.as_tensor(values, dtype=torch.float64)


def total(bits):
    return float(bits.detach().sum())


TWO_MODES = MixtureContext(t([0.0, 0.5]), t([-2.0, 3.0]), t([1.0, 4.0]))


def mixed(family="gaussian", n=N):
    logits, mean, scale = t([0.5, 0.0, -2.0]), t([-4.0, 1.5, 0.0]), t([0.4, 1.0, 9.0])
    weights = torch.softmax(logits, 0).numpy()
    pick = rng(6).choice(3, n, p=weights)
    draw = FAMILIES[family].rvs(mean.numpy()[pick], scale.numpy()[pick], random_state=rng(7))
    return draw, MixtureContext(logits, mean, scale, 0.25, family)


@pytest.mark.parametrize("family", FAMILIES)
def test_a_mixture_sums_to_one_and_is_that_of_scipy(family):
    _, context = mixed(family, 1)
    k = np.arange(-4000, 4001)
    p = 2 ** -rates.mixture_bits(
        t(k * 0.25), context.logits, context.mean, context.scale, 0.25, family=family, p_min=1e-300
    )
    assert total(p) == pytest.approx(1, abs=1e-6)
    weights = torch.softmax(context.logits, 0).numpy()
    near = np.abs(k) < 40
    expected = sum(
        w * (FAMILIES[family].cdf(k * 0.25 + 0.125, m, s) - FAMILIES[family].cdf(k * 0.25 - 0.125, m, s))
        for w, m, s in zip(weights, context.mean.numpy(), context.scale.numpy(), strict=True)
    )
    np.testing.assert_allclose(p.numpy()[near], expected[near], rtol=1e-8)


def test_a_mixture_of_one_is_its_component_and_trains():
    x = torch.linspace(-6, 6, 31, dtype=torch.float64)
    one = rates.mixture_bits(x, t([0.3]), t([0.5]), t([2.0]), 0.5)
    torch.testing.assert_close(one, rates.gaussian_bits(x, 0.5, 2.0, 0.5))
    arguments = [a.requires_grad_() for a in (x[:4].clone(), t([0.1, 0.4]), t([0.5, -1.0]), t([2.0, 0.7]))]
    assert torch.autograd.gradcheck(lambda *a: rates.mixture_bits(*a, 0.5), arguments)
    far = rates.mixture_bits(t([40.0]), t([0.0, 0.0]), t([0.0, 0.0]), t([1.0, 1.0]))
    assert far.item() == pytest.approx(24)


@pytest.mark.parametrize("family", FAMILIES)
def test_a_mixture_costs_what_it_estimates(family):
    draw, context = mixed(family)
    symbols = np.rint(draw / 0.25).astype(int)
    estimate = total(Mixture().bits(t(symbols * 0.25), context))
    data = Mixture().encode(symbols, context)
    assert np.array_equal(Mixture().decode(data, (N,)), symbols)
    assert 8 * len(data) == pytest.approx(estimate, rel=0.005)


def test_parameters_per_symbol_train_and_per_column_code():
    x = t(rng(8).normal(size=(50, 2)))
    bits = Mixture().bits(x, MixtureContext(t(np.zeros((50, 2, 3))), t(np.zeros((50, 2, 3))), t(np.ones(3)), t([1, 2])))
    torch.testing.assert_close(bits[:, 1], rates.gaussian_bits(x[:, 1], 0.0, 1.0, 2.0))
    context = MixtureContext(t([0.0, 1.0]), t([[0, 4], [-9, 2]]), t([[1, 1], [2, 2]]), t([1.0, 0.5]))
    symbols = np.rint(rng(9).normal(0, 6, (2000, 2))).astype(int)
    assert np.array_equal(Mixture().decode(Mixture().encode(symbols, context), (2000, 2)), symbols)
    with pytest.raises(ValueError, match="one mixture a column"):
        Mixture().encode(symbols, MixtureContext(t(np.zeros((2000, 3))), t(np.zeros(3)), t(np.ones(3))))


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(numbers, numbers), max_size=30))
def test_any_matrix_under_a_mixture(rows):
    """No rows, one, columns of one value, and most of them far outside of the density."""
    matrix = np.array(rows, np.int64).reshape(-1, 2)
    assert np.array_equal(Mixture().decode(Mixture().encode(matrix, TWO_MODES), matrix.shape), matrix)


def test_constant_columns_and_rare_outliers():
    model, context = Mixture(), TWO_MODES
    matrix = np.rint(rng(11).normal(0, 3, (5000, 2))).astype(int)
    matrix[::1000, 0] = [10**6, -(10**6), 2**37, -(2**37), 777]
    data = model.encode(matrix, context)
    assert np.array_equal(model.decode(data, matrix.shape), matrix)
    # An escape of 2^37 takes 76 bits more than the 24 at which the estimate stops; the tables take 100 bytes.
    assert 8 * len(data) < total(model.bits(t(matrix), context)) + 5 * 80 + 8 * 150
    constant = np.full((5000, 2), 3)
    data = model.encode(constant, context)
    assert len(data) < 60
    assert np.array_equal(model.decode(data, constant.shape), constant)


def test_a_table_covers_what_occurs_and_no_more_than_it_may():
    matrix = np.stack([np.arange(-50, 50), np.full(100, 10**6), np.arange(100) * 1000], 1)
    spans = density_tables.windows(matrix, np.array([-10.2, -5.0, -1e9]), np.array([20.7, 5.0, np.inf]))
    assert spans[:2] == [(-11, 21), (5, 5)]
    assert spans[2].size == density_tables.SIZE_LIMIT
    assert spans[2].low < np.median(matrix[:, 2]) < spans[2].high
    with pytest.raises(ValueError, match="not finite"):
        density_tables.windows(matrix[:, :1], np.array([np.nan]), np.array([1.0]))


def test_damage_to_columns_under_densities_is_found(assert_survives_damage):
    model, context = Mixture(), TWO_MODES
    matrix = np.rint(rng(12).normal(0, 2, (30, 2))).astype(int)
    matrix[3] = [4000, -90_000]
    data = model.encode(matrix, context)
    assert_survives_damage(data, lambda d: model.decode(d, matrix.shape), matrix)
    for shape in ((30,), (31, 2), (30, 3), (1 << 40, 2)):
        with pytest.raises(BitstreamError):
            model.decode(data, shape)


def test_densities_that_make_no_sense_are_refused():
    symbols = np.zeros((4, 2), int)
    for logits, mean, scale, step in (
        ([0.0], [np.nan], [1.0], 1.0),
        ([0.0], [0.0], [0.0], 1.0),
        ([np.inf], [0.0], [1.0], 1.0),
        ([0.0], [0.0], [1.0], 0.0),
        ([0.0], [0.0], [1.0], -1.0),
    ):
        with pytest.raises(ValueError):
            Mixture().encode(symbols, MixtureContext(t(logits), t(mean), t(scale), step))
    with pytest.raises(ValueError, match="not known"):
        MixtureContext(t([0.0]), t([0.0]), t([1.0]), family="cauchy")
    with pytest.raises(ValueError, match=r"2\^38"):
        Mixture().encode(symbols + (1 << 39), TWO_MODES)
    with pytest.raises(ValueError, match="not finite"):
        density_tables.encode(symbols, [density_tables.Window(0, 1)] * 2, lambda *_: np.full(2, np.nan))


def test_the_context_is_reached_through_the_registered_class():
    assert load_plugins().entropy_models.load("mixture").Context is MixtureContext
