"""gaussian-exact and the integer network: exact on any thread count and batch size, and not larger."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from splatwizard_core.errors import BitstreamError
from sw_codecs.context.integer_mlp import IntegerMlp, to_fixed
from sw_codecs.entropy.gaussian_exact import FloatContext, GaussianExact, IntegerContext, step_multipliers


def drawn(n, seed=0, low=0.2, high=20.0):
    """Mean, scale and rounded samples in steps."""
    r = np.random.default_rng(seed)
    mean, scale = r.normal(0, 20, n), np.exp(r.uniform(np.log(low), np.log(high), n))
    return mean, scale, np.rint(r.normal(mean, scale)).astype(np.int64)


@pytest.mark.parametrize("n", [0, 1, 2, 5000])
def test_round_trip(n):
    mean, scale, symbols = drawn(n)
    context = IntegerContext(to_fixed(mean), to_fixed(scale))
    found = GaussianExact().decode(GaussianExact().encode(symbols, context), context)
    assert found.dtype == np.int32
    assert np.array_equal(found, symbols)


def test_contexts_are_reached_through_the_registered_class():
    """A method of another package has the class from the registry and imports nothing of ours."""
    model = GaussianExact()
    multiplier = model.step_multipliers(np.zeros(3, np.int64))
    context = model.IntegerContext(np.zeros(3, np.int64), np.full(3, 4096), multiplier)
    assert np.array_equal(model.decode(model.encode(np.arange(3), context), context), np.arange(3))
    assert model.bits(torch.zeros(2), model.FloatContext(0.0, 1.0)).shape == (2,)


symbols_and_parameters = st.lists(
    st.tuples(
        st.integers(-(2**30) + 1, 2**30 - 1) | st.integers(-5, 5),
        st.integers(-(2**31), 2**31) | st.integers(-(2**40), 2**40) | st.integers(-40_000, 40_000),
        st.integers(-(2**47), 2**47) | st.integers(0, 300_000),
        st.integers(64, 8192),
    ),
    max_size=25,
)


@settings(max_examples=150, deadline=None)
@given(symbols_and_parameters)
def test_any_symbols_under_any_parameters(rows):
    symbols, mean, scale, multiplier = np.array(rows, np.int64).reshape(-1, 4).T
    keep = np.abs(mean // multiplier) < 2**29
    context = IntegerContext(mean[keep], scale[keep], multiplier[keep])
    data = GaussianExact().encode(symbols[keep], context)
    assert np.array_equal(GaussianExact().decode(data, context), symbols[keep])


def test_escapes_at_both_ends():
    symbols = np.array([-1_000_000, 1_000_000, 0, -2, 2, 3, -3, 2**30 - 1, 1 - 2**30] * 3)
    context = IntegerContext(np.zeros(27, np.int64), np.full(27, 200))  # scale 0.05: entries -2..2
    assert np.array_equal(GaussianExact().decode(GaussianExact().encode(symbols, context), context), symbols)


@pytest.mark.parametrize(
    ("low", "high", "within"),
    [
        # The lattice of 64 scales x 8 fractions costs 0.003 bit per symbol.
        (1.0, 1.5, 0.005),
        (0.2, 20.0, 0.005),
        (15.0, 20.0, 0.005),
        # A mean between two eighths is 1/16 off, here a quarter of the scale: 0.01 bit of 0.64 a symbol.
        (0.2, 0.3, 0.02),
    ],
)
def test_real_size_agrees_with_the_training_estimate(low, high, within):
    mean, scale, symbols = drawn(100_000, low=low, high=high)
    size = 8 * len(GaussianExact().encode(symbols, IntegerContext(to_fixed(mean), to_fixed(scale))))
    values = torch.from_numpy(symbols.astype(float))
    estimate = GaussianExact().bits(values, FloatContext(torch.from_numpy(mean), torch.from_numpy(scale))).sum()
    assert size == pytest.approx(float(estimate), rel=within)


def test_real_size_agrees_with_the_tables():
    mean, scale, symbols = drawn(100_000)
    context = IntegerContext(to_fixed(mean), to_fixed(scale))
    size = 8 * len(GaussianExact().encode(symbols, context))
    assert size == pytest.approx(GaussianExact().table_bits(symbols, context).sum(), rel=0.002)


def test_the_step_changes_the_unit_of_the_parameters():
    # Mean 10 and scale 2 base steps are mean 20 and scale 4 in steps of half a base step (multiplier 2048).
    n = 20_000
    symbols = np.rint(np.random.default_rng(1).normal(20, 4, n)).astype(int)
    half = IntegerContext(to_fixed(np.full(n, 10.0)), to_fixed(np.full(n, 2.0)), 2048)
    whole = IntegerContext(to_fixed(np.full(n, 20.0)), to_fixed(np.full(n, 4.0)), np.full(n, 4096))
    assert GaussianExact().encode(symbols, half) == GaussianExact().encode(symbols, whole)


def test_step_multipliers_follow_1_plus_tanh():
    t = np.array([-(2**20), -32_768, 0, 4096, 2**20])
    expected = 4096 * (1 + np.tanh(np.clip(t / 4096 + 0.5 / 8, -8 + 0.5 / 8, 8 - 0.5 / 8)))
    assert np.abs(step_multipliers(t) - np.maximum(64, expected)).max() <= 1


def test_step_multipliers_take_no_floats():
    with pytest.raises(ValueError, match="integers"):
        step_multipliers(np.array([0.5]))


def test_damage_is_found(assert_survives_damage):
    mean, scale, symbols = drawn(40)
    symbols[3] += 300  # an escape
    context = IntegerContext(to_fixed(mean), to_fixed(scale))
    data = GaussianExact().encode(symbols, context)
    assert_survives_damage(data, lambda d: GaussianExact().decode(d, context), symbols)


def test_another_context_is_found():
    mean, scale, symbols = drawn(500)
    data = GaussianExact().encode(symbols, IntegerContext(to_fixed(mean), to_fixed(scale)))
    mean[7] += 1
    with pytest.raises(BitstreamError):
        GaussianExact().decode(data, IntegerContext(to_fixed(mean), to_fixed(scale)))
    with pytest.raises(BitstreamError):
        GaussianExact().decode(data, IntegerContext(to_fixed(mean[1:]), to_fixed(scale[1:])))


@pytest.mark.parametrize(
    "context",
    [
        IntegerContext(np.zeros(3), np.ones(3, int)),
        IntegerContext(np.zeros(2, int), np.ones(3, int)),
        IntegerContext(np.zeros(3, int), np.ones(3, int), 63),
        IntegerContext(np.zeros(3, int), np.ones(3, int), 16385),
        IntegerContext(np.full(3, 2**48), np.ones(3, int)),
        IntegerContext(np.full(3, 2**44), np.ones(3, int)),
    ],
)
def test_bad_parameters_are_refused_on_both_sides(context):
    with pytest.raises(ValueError):
        GaussianExact().encode(np.zeros(3, int), context)
    data = GaussianExact().encode(np.zeros(3, int), IntegerContext(np.zeros(3, int), np.ones(3, int)))
    with pytest.raises(BitstreamError):
        GaussianExact().decode(data, context)


def network(seed=0):
    torch.manual_seed(seed)
    return nn.Sequential(nn.Linear(24, 50), nn.ReLU(), nn.Linear(50, 12))


def inputs(rows, seed=0):
    return torch.from_numpy(np.random.default_rng(seed).integers(-(2**14), 2**14, (rows, 24)))


def test_the_integer_network_is_near_the_float_network():
    net = network()
    exact = IntegerMlp.from_module(net, output_scale=5.0)(inputs(2000))
    with torch.no_grad():
        approximate = net(inputs(2000).float() / 4096) * 5.0
    # 12 fractional bits: each of 24 + 50 terms off by up to 2^-13 of its input of up to 4.
    assert (exact.double() / 4096 - approximate).abs().max() < 0.02


def test_the_integer_network_equals_integer_arithmetic():
    net = network()
    mlp = IntegerMlp.from_module(net)
    a = inputs(50).numpy().astype(object)
    for i, layer in enumerate((net[0], net[2])):
        w = np.vectorize(int, otypes=[object])(np.rint(layer.weight.detach().numpy().astype(float) * 2**12))
        b = np.vectorize(int, otypes=[object])(np.rint(layer.bias.detach().numpy().astype(float) * 2**24))
        a = (a @ w.T + b) >> 12  # Python integers: floor
        if i == 0:
            a = np.clip(a, 0, 2**20)
    assert np.array_equal(mlp(inputs(50)).numpy(), a.astype(np.int64))


@pytest.mark.parametrize("rows", [1, 7, 3000, 10_000])
def test_the_integer_network_does_not_depend_on_the_batch(rows):
    mlp = IntegerMlp.from_module(network())
    assert torch.equal(mlp(inputs(4000), rows=rows), mlp(inputs(4000), rows=1 << 16))


def coded_through_the_network(rows):
    """A file part whose probabilities come out of the network, evaluated `rows` rows at a time."""
    out = IntegerMlp.from_module(network())(inputs(4000), rows=rows).numpy()
    context = IntegerContext(out[:, :4].ravel(), np.abs(out[:, 4:8]).ravel(), step_multipliers(out[:, 8:]).ravel())
    symbols = np.rint(np.random.default_rng(2).normal(0, 3, context.mean.shape)).astype(int)
    return GaussianExact().encode(symbols, context)


def test_bytes_are_the_same_with_one_and_two_threads_and_any_batch_size():
    threads = torch.get_num_threads()
    try:
        coded = set()
        for count, rows in ((1, 1 << 16), (1, 7), (2, 1), (2, 3000), (2, 1 << 16)):
            torch.set_num_threads(count)
            coded.add(coded_through_the_network(rows))
    finally:
        torch.set_num_threads(threads)
    assert len(coded) == 1


@pytest.mark.cuda
def test_a_file_coded_on_cuda_decodes_on_cpu():
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    mlp = IntegerMlp.from_module(network())
    there = IntegerMlp.from_module(network().cuda())
    for rows in (1, 7, 3000, 1 << 16):
        assert torch.equal(there(inputs(4000).cuda(), rows=rows).cpu(), mlp(inputs(4000)))


def test_integer_parameters_cost_less_than_a_permille_over_float_ones():
    # The same network, once exact and once in float: what the fixed point costs in rate (specification: < 0.2 %).
    net, x = network(), inputs(20_000)
    out = IntegerMlp.from_module(net)(x).numpy()
    with torch.no_grad():
        ideal = net.double()(x.double() / 4096).numpy()
    r = np.random.default_rng(3)
    mean, scale = 20 * ideal[:, :6], np.exp(ideal[:, 6:])
    symbols = np.rint(r.normal(mean, scale)).astype(int)

    def size(m, s):
        return len(GaussianExact().encode(symbols.ravel(), IntegerContext(to_fixed(m).ravel(), to_fixed(s).ravel())))

    rounded = out / 4096.0
    assert size(20 * rounded[:, :6], np.exp(rounded[:, 6:])) < 1.002 * size(mean, scale)


def test_networks_that_cannot_be_exact_are_refused():
    w, b = np.ones((2, 3), np.float32), np.zeros(2, np.float32)
    for weights in (
        [], [(w * 5000, b)], [(w * np.nan, b)], [(w, b + np.float32(1e12))], [(w, b[:1])], [(w, b), (w, b)],
        [(np.full((2, 600), 4000, np.float32), b)],
    ):  # fmt: skip
        with pytest.raises(ValueError):
            IntegerMlp(weights)
    with pytest.raises(ValueError, match="Tanh"):
        IntegerMlp.from_module(nn.Sequential(nn.Linear(3, 3), nn.Tanh(), nn.Linear(3, 3)))


def test_a_network_comes_back_from_its_arrays():
    mlp = IntegerMlp.from_module(network(), output_scale=3.0)
    again = IntegerMlp.from_state(mlp.state(), output_scale=3.0)
    assert torch.equal(again(inputs(30)), mlp(inputs(30)))
    for state in ({}, {"weight0": np.zeros((2, 2))}, {"weight0": np.full((2, 2), np.inf), "bias0": np.zeros(2)}):
        with pytest.raises(BitstreamError, match="context network"):
            IntegerMlp.from_state(state)
