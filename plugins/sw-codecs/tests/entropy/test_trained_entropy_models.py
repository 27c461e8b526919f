"""gaussian, laplace, mixture and factorised: probabilities, round trips, estimate against size, damage."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from splatwizard_core.errors import BitstreamError
from splatwizard_core.plugins import load_plugins
from sw_codecs.entropy import density_tables, float_models, rates
from sw_codecs.entropy.factorised import Factorised
from sw_codecs.entropy.float_models import GaussianFloat, LaplaceFloat
from sw_codecs.entropy.gaussian_exact import FloatContext
from sw_codecs.entropy.mixture import Mixture, MixtureContext

N = 100_000
FLOATS = {"gaussian": (GaussianFloat, stats.norm), "laplace": (LaplaceFloat, stats.laplace)}
numbers = st.integers(-(2**29), 2**29) | st.integers(-30, 30)


def rng(seed=0):
    return np.random.default_rng(seed)


def t(values):
    return torch.as_tensor(values, dtype=torch.float64)


def total(bits):
    return float(bits.detach().sum())


# gaussian, laplace: float parameters


@settings(max_examples=100, deadline=None)
@given(
    st.sampled_from(sorted(FLOATS)),
    st.lists(st.tuples(numbers, st.floats(-(2.0**29), 2.0**29), st.floats(1e-3, 1e6)), max_size=30),
    st.sampled_from([1.0, 0.37, 1000.0]),
)
def test_any_symbols_under_any_float_parameters(name, rows, step):
    """No symbols, one, outliers far beyond the scale, means far from all symbols."""
    symbols, mean, scale = (np.array(column) for column in zip(*rows, strict=True)) if rows else (np.empty(0),) * 3
    symbols = symbols.astype(np.int64)
    context = FloatContext(mean * step, scale * step, step)
    model = FLOATS[name][0]()
    found = model.decode(model.encode(symbols, context), context)
    assert found.dtype == np.int32
    assert np.array_equal(found, symbols)


@pytest.mark.parametrize("name", FLOATS)
def test_constant_symbols_and_outliers_under_floats(name):
    model = FLOATS[name][0]()
    for symbols in (np.full(500, 7), np.where(np.arange(5000) % 1000 == 3, 10**9, np.arange(5000) % 3)):
        context = FloatContext(t(np.zeros(len(symbols))), 1.0)
        data = model.encode(symbols, context)
        assert np.array_equal(model.decode(data, context), symbols)
        # Five outliers cost escapes, not a domain of 2^30 symbols: the others have 2.3 bits each.
        assert len(data) < (40 if len(symbols) == 500 else 1550)


@pytest.mark.parametrize("name", FLOATS)
@pytest.mark.parametrize(("low", "high"), [(0.2, 0.25), (0.2, 20.0), (19.0, 20.0)])
def test_float_models_cost_what_they_estimate(name, low, high):
    model, family = FLOATS[name][0](), FLOATS[name][1]
    step = 0.25
    mean, scale = rng(1).normal(0, 30, N) * step, np.exp(rng(2).uniform(np.log(low), np.log(high), N)) * step
    symbols = np.rint(family.rvs(mean, scale, random_state=rng(3)) / step).astype(int)
    context = FloatContext(t(mean), t(scale), step)
    estimate = total(model.bits(t(symbols * step), context))
    away = -np.abs(symbols * step - mean)
    mass = family.cdf(away + step / 2, 0, scale) - family.cdf(away - step / 2, 0, scale)
    assert estimate == pytest.approx(-np.log2(mass).sum(), rel=1e-6)
    assert 8 * len(model.encode(symbols, context)) == pytest.approx(estimate, rel=0.005)


@pytest.mark.parametrize("name", FLOATS)
def test_rare_outliers_leave_the_size_near_the_estimate(name):
    model = FLOATS[name][0]()
    symbols = np.rint(FLOATS[name][1].rvs(0, 1.0, size=N, random_state=rng(4))).astype(int)
    symbols[::1000] += 100_000_000
    context = FloatContext(t(np.zeros(N)), t(np.ones(N)))
    data = model.encode(symbols, context)
    assert np.array_equal(model.decode(data, context), symbols)
    # The estimate stops at 24 bits, which an escape of 10^8 exceeds by the 54 bits of its Exp-Golomb code.
    assert 8 * len(data) == pytest.approx(total(model.bits(t(symbols), context)) + N // 1000 * 54, rel=0.005)


@pytest.mark.parametrize("name", FLOATS)
def test_damage_to_float_coded_data_is_found(assert_survives_damage, name):
    model, symbols = FLOATS[name][0](), np.array([0, 1, -2, 5000, 3, -70_000, 0, 1] * 5)
    context = FloatContext(t(np.linspace(-2, 2, 40)), 1.5)
    data = model.encode(symbols, context)
    assert_survives_damage(data, lambda d: model.decode(d, context), symbols)


@pytest.mark.parametrize("name", FLOATS)
def test_hostile_float_coded_data_with_their_checksums_in_order(monkeypatch, name):
    monkeypatch.setattr("sw_codecs.bits.checksum.crc32", lambda data, value=0: 0)
    model, r, n = FLOATS[name][0](), rng(13), 60
    context = FloatContext(t(r.normal(0, 3, n)), 1.5)
    symbols = np.rint(r.normal(0, 3, n)).astype(int)
    symbols[::9] += 10**6
    data, decoded = model.encode(symbols, context), 0
    for _ in range(400):
        changed = bytearray(data)
        for at in r.integers(0, len(data), r.integers(1, 4)):
            changed[at] = r.integers(256)
        try:
            found = model.decode(bytes(changed[: r.integers(1, 2 * len(data))]), context)
        except BitstreamError:
            continue
        assert (found.shape, found.dtype) == ((n,), np.int32)
        decoded += 1
    assert decoded  # some of it is well formed


@pytest.mark.parametrize("name", FLOATS)
def test_other_floats_than_the_encoders_are_named(name):
    model, mean = FLOATS[name][0](), rng(5).normal(0, 3, 100)
    data = model.encode(np.rint(mean).astype(int), FloatContext(t(mean), 1.0))
    moved = mean.copy()
    moved[7] = np.nextafter(moved[7], 9)
    for context in (FloatContext(t(moved), 1.0), FloatContext(t(mean), 1.0 + 2**-52)):
        with pytest.raises(BitstreamError, match="not those"):
            model.decode(data, context)
    for context in (FloatContext(t(mean[:50]), 1.0), FloatContext(0.0, 1.0), FloatContext(t(mean), np.nan)):
        with pytest.raises(BitstreamError):
            model.decode(data, context)


@pytest.mark.parametrize(
    ("mean", "scale", "step"),
    [
        (np.nan, 1.0, 1.0),
        (np.inf, 1.0, 1.0),
        (1e12, 1.0, 1.0),
        (0.0, 0.0, 1.0),
        (0.0, -1.0, 1.0),
        (0.0, np.inf, 1.0),
        (0.0, 1.0, 0.0),
        (0.0, 1.0, np.nan),
    ],
)
def test_float_parameters_that_make_no_sense_are_refused(mean, scale, step):
    for model, _ in FLOATS.values():
        with pytest.raises(ValueError):
            model().encode(np.zeros(3, int), FloatContext(np.full(3, mean), scale, step))
    with pytest.raises(ValueError):
        GaussianFloat().encode(np.array([1 << 30]), FloatContext(np.zeros(1), 1.0))
    with pytest.raises(ValueError):
        GaussianFloat().encode(np.zeros(3, int), FloatContext(0.0, 1.0))


def test_the_radius_weighs_leaked_probability_against_escapes():
    assert float_models._radius(np.array([], np.int64)) == 1
    assert float_models._radius(np.full(1000, 3)) == 4
    assert float_models._radius(np.append(np.zeros(10**6, np.int64), [2**29])) <= 2
    wide = np.arange(1 << 16)
    assert float_models._radius(wide) == 1 << 16


# mixture


def mixed(family="gaussian", n=N):
    logits, mean, scale = t([0.5, 0.0, -2.0]), t([-4.0, 1.5, 0.0]), t([0.4, 1.0, 9.0])
    weights = torch.softmax(logits, 0).numpy()
    pick = rng(6).choice(3, n, p=weights)
    draw = FLOATS[family][1].rvs(mean.numpy()[pick], scale.numpy()[pick], random_state=rng(7))
    return draw, MixtureContext(logits, mean, scale, 0.25, family)


@pytest.mark.parametrize("family", FLOATS)
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
        w * (FLOATS[family][1].cdf(k * 0.25 + 0.125, m, s) - FLOATS[family][1].cdf(k * 0.25 - 0.125, m, s))
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


@pytest.mark.parametrize("family", FLOATS)
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


# factorised


@pytest.fixture(scope="module")
def trained():
    """Three channels trained for a moment: a narrow one, one with two modes, a wide one off the origin."""
    torch.manual_seed(0)
    r = rng(10)
    n = N
    values = np.stack(
        [
            r.laplace(0, 0.6, n),
            np.where(r.random(n) < 0.3, r.normal(-6, 1, n), r.normal(4, 0.5, n)),
            r.normal(9, 12, n),
        ],
        1,
    )
    model = Factorised(3, init_scale=8)
    optimizer = torch.optim.Adam(model.parameters(), lr=0.03)
    x = torch.from_numpy(values).float()
    for _ in range(400):
        batch = x[torch.randint(n, (1024,))]
        optimizer.zero_grad()
        model.bits(batch + torch.rand_like(batch) - 0.5).mean().backward()
        optimizer.step()
    return model, np.rint(values).astype(np.int64)


def test_a_fresh_density_is_a_distribution():
    torch.manual_seed(1)
    model = Factorised(4, filters=(3, 5), init_scale=4)
    k = torch.arange(-3000, 3001, dtype=torch.float64)[:, None].expand(-1, 4)
    for step in (1.0, t([0.5, 1.0, 2.0, 4.0])):
        p = 2 ** -model.bits(k * step, Factorised.Context(step, smallest_probability=1e-300))
        torch.testing.assert_close(p.sum(0), torch.ones(4, dtype=torch.float64), atol=1e-6, rtol=0)
    grid = torch.linspace(-60, 60, 999, dtype=torch.float64).expand(4, -1)
    assert (model.logits(grid).diff(dim=1) > 0).all()


def test_training_finds_the_entropy(trained):
    model, symbols = trained
    found = model.bits(torch.from_numpy(symbols)).mean(0).tolist()
    for channel, bits in enumerate(found):
        counts = np.unique(symbols[:, channel], return_counts=True)[1]
        entropy = -(counts / N * np.log2(counts / N)).sum()
        assert entropy < bits < entropy + 0.08


def test_a_density_sums_to_one_after_training_and_its_quantiles_are_where_they_should_be(trained):
    model, _ = trained
    k = torch.arange(-20_000, 20_001, dtype=torch.float64)[:, None].expand(-1, 3)
    p = 2 ** -model.bits(k, Factorised.Context(smallest_probability=1e-300))
    torch.testing.assert_close(p.sum(0), torch.ones(3, dtype=torch.float64), atol=1e-6, rtol=0)
    logits = model.logits(model.quantiles())
    torch.testing.assert_close(torch.sigmoid(logits[:, 0]), t([5e-10] * 3), rtol=1e-6, atol=0, check_dtype=False)
    torch.testing.assert_close(torch.sigmoid(-logits[:, 1]), t([5e-10] * 3), rtol=1e-6, atol=0, check_dtype=False)


def test_factorised_costs_what_it_estimates_and_a_fresh_object_decodes(trained):
    model, symbols = trained
    data = model.encode(symbols)
    assert np.array_equal(Factorised(3).decode(data, symbols.shape), symbols)
    assert 8 * len(data) == pytest.approx(total(model.bits(torch.from_numpy(symbols).double())), rel=0.005)


def test_a_step_other_than_one_changes_the_bins_alone(trained):
    model, symbols = trained
    context = Factorised.Context(t([0.5, 1.0, 2.0]))
    indices = np.rint(symbols / [0.5, 1.0, 2.0]).astype(int)
    data = model.encode(indices, context)
    assert np.array_equal(model.decode(data, indices.shape), indices)
    estimate = total(model.bits(t(indices) * context.step, context))
    assert 8 * len(data) == pytest.approx(estimate, rel=0.02)


def test_forty_scales_out_everything_is_finite():
    torch.manual_seed(4)
    model = Factorised(init_scale=1)
    x = t([-400.0, 400.0]).requires_grad_()
    bits = model.bits(x)
    assert bits.tolist() == pytest.approx([24, 24])
    bits.sum().backward()
    assert all(torch.isfinite(p.grad).all() for p in (x, *model.parameters()))


def test_a_distant_value_is_pulled_back_or_left_alone():
    torch.manual_seed(2)
    model = Factorised(init_scale=1)
    for flag in (True, False):
        x = t([200.0]).requires_grad_()
        bits = model.bits(x, Factorised.Context(smallest_probability=0.01, grad_below_bound=flag))
        assert bits.item() == pytest.approx(-math.log2(0.01))
        model.zero_grad()
        bits.backward()
        moved = any(bool(p.grad.abs().sum() > 0) for p in model.parameters())
        assert moved is False if not flag else torch.isfinite(x.grad).all()
    near = t([7.0]).requires_grad_()
    model.bits(near, Factorised.Context(smallest_probability=0.5)).backward()
    assert near.grad.item() > 0  # below the bound, but descent raises p: towards the middle


# what mixture and factorised share


def coders_of_columns():
    torch.manual_seed(3)
    mixture = MixtureContext(t([0.0, 0.5]), t([-2.0, 3.0]), t([1.0, 4.0]))
    return {"mixture": (Mixture(), mixture), "factorised": (Factorised(2), None)}


@settings(max_examples=50, deadline=None)
@given(st.sampled_from(["mixture", "factorised"]), st.lists(st.tuples(numbers, numbers), max_size=30))
def test_any_matrix_under_any_density(name, rows):
    """No rows, one, columns of one value, and most of them far outside of the density."""
    model, context = coders_of_columns()[name]
    matrix = np.array(rows, np.int64).reshape(-1, 2)
    assert np.array_equal(model.decode(model.encode(matrix, context), matrix.shape), matrix)


@pytest.mark.parametrize("name", ["mixture", "factorised"])
def test_constant_columns_and_rare_outliers(name):
    model, context = coders_of_columns()[name]
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


@pytest.mark.parametrize("name", ["mixture", "factorised"])
def test_damage_to_columns_under_densities_is_found(assert_survives_damage, name):
    model, context = coders_of_columns()[name]
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
    for arguments in ({"channels": 0}, {"tail_mass": 0.0}, {"init_scale": -1.0}):
        with pytest.raises(ValueError, match="must be positive"):
            Factorised(**arguments)
    model = Factorised(2)
    with pytest.raises(ValueError, match="do not have 2"):
        model.encode(np.zeros(4, int))
    with pytest.raises(ValueError, match="do not end in 2"):
        model.bits(torch.zeros(3))
    with pytest.raises(ValueError, match="must be positive"):
        model.encode(symbols, Factorised.Context(-1.0))
    with pytest.raises(ValueError, match=r"2\^38"):
        model.encode(symbols + (1 << 39))
    model.biases[0].data.fill_(math.nan)
    with pytest.raises(ValueError, match="not finite"):
        model.encode(symbols)


def test_the_contexts_are_reached_through_the_registered_classes():
    models = load_plugins().entropy_models
    for name in ("gaussian", "laplace", "mixture", "factorised"):
        assert isinstance(models.load(name).Context, type)
