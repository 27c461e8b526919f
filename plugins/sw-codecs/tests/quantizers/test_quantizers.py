"""Scalar quantizers: lattices, gradients, exact inverses, refused side information."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from splatwizard_core.errors import BitstreamError
from sw_codecs.quantizers.binary import SteBinary, SteMask
from sw_codecs.quantizers.rounding import SteRound, add_noise
from sw_codecs.quantizers.uniform import Uniform


def gen(seed=0):
    return torch.Generator().manual_seed(seed)


def test_uniform_by_hand():
    q = Uniform(2, low=-1.0, high=2.0)  # lattice -1, 0, 1, 2
    x = torch.tensor([-5.0, -0.6, 0.4, 0.6, 1.9, 7.0], requires_grad=True)
    symbols, side = q.encode(x)
    assert symbols.tolist() == [0, 0, 1, 2, 3, 3]
    assert (side["low"].tolist(), side["step"].tolist(), side["bits"].tolist()) == ([-1.0], [1.0], [2])
    assert q.decode(symbols, side).tolist() == [-1, -1, 0, 1, 2, 2]
    out = q.forward(x)
    assert out.tolist() == [-1, -1, 0, 1, 2, 2]
    out.sum().backward()
    assert x.grad.tolist() == [0, 1, 1, 1, 1, 0]  # 1 inside the range, 0 outside


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 24), st.integers(0, 30), st.integers(1, 4), st.integers(0, 2**31), st.floats(1e-6, 1e6))
def test_uniform_error_is_half_a_step_and_decoded_values_stay(bits, n, channels, seed, spread):
    x = torch.randn(n, channels, generator=gen(seed)) * spread
    symbols, side = Uniform(bits).encode(x)
    decoded = Uniform.decode(symbols, side)
    step = torch.from_numpy(side["step"])
    # Half a step, and the float32 rounding of values and ends.
    assert ((decoded - x).abs() <= 0.5 * step + 4e-7 * spread * 20).all()
    top = side["low"] + side["step"].astype(float) * (2.0**bits - 1)
    if bits <= 20:  # beyond, float32 values are coarser than the lattice
        again, _ = Uniform(bits, low=side["low"], high=top).encode(decoded)
        assert torch.equal(again, symbols)
        assert torch.allclose(Uniform(bits).forward(x), decoded, rtol=1e-6, atol=1e-6 * spread)


def test_uniform_takes_bits_and_range_per_channel():
    x = torch.rand(200, 3, generator=gen())
    symbols, side = Uniform([1, 4, 8], low=[0.0, 0.0, 0.5], high=1.0).encode(x)
    assert symbols.amax(0).tolist() == [1, 15, 255]
    assert side["low"].tolist() == [0, 0, 0.5]
    assert torch.equal(symbols[:, 2] == 0, x[:, 2] <= 0.5 + 0.25 / 255)


def test_uniform_noise_has_the_width_of_a_step():
    x = torch.linspace(0, 1, 10_001)
    out = Uniform(4, noise=True).forward(x, gen())
    moved = (out - x)[1000:-1000] * 15
    assert moved.abs().max() <= 0.5
    assert moved.std() == pytest.approx(1 / 12**0.5, rel=0.03)  # 8,000 samples


def test_constant_and_empty_channels():
    for x in (torch.full((5, 2), 3.25), torch.empty(0, 2)):
        symbols, side = Uniform(8).encode(x)
        assert torch.equal(Uniform.decode(symbols, side), x)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_values_that_are_not_finite_are_refused(value):
    with pytest.raises(ValueError, match="finite"):
        Uniform(8).encode(torch.tensor([0.0, value]))
    with pytest.raises(ValueError, match="finite"):
        SteRound(1.0).encode(torch.tensor([0.0, value]))


def test_ranges_that_make_no_lattice_are_refused():
    with pytest.raises(ValueError, match="ends before it starts"):
        Uniform(8, low=[0.0, 1.0], high=0.5)
    with pytest.raises(ValueError, match="float32"):
        Uniform(8).encode(torch.tensor([0.0, 1e300], dtype=torch.float64))


@pytest.mark.parametrize("bits", [0, 25, 2.5, [8, 0]])
def test_bits_must_be_whole_and_in_range(bits):
    with pytest.raises(ValueError, match="bits"):
        Uniform(bits)


def test_hostile_side_information_is_refused():
    symbols, side = Uniform(4).encode(torch.rand(10, 2, generator=gen()))
    for key, value in (
        ("low", side["low"][:1]),
        ("step", np.array([0.0, 1.0], np.float32)),
        ("step", np.array([np.nan, 1], np.float32)),
        ("low", np.array([np.inf, 1], np.float32)), ("bits", np.array([4, 99], np.uint8)), ("bits", None),
    ):  # fmt: skip
        with pytest.raises(BitstreamError):
            Uniform.decode(symbols, {**side, key: value})
    for bad in (symbols + 16, symbols - 16):
        with pytest.raises(BitstreamError, match="index"):
            Uniform.decode(bad, side)


def test_rounding_is_half_to_even_with_gradient_one():
    x = torch.tensor([0.25, 0.75, 1.25, -0.3], requires_grad=True)
    out = SteRound(0.5).forward(x)
    assert out.tolist() == [0.0, 1.0, 1.0, -0.5]
    out.sum().backward()
    assert x.grad.tolist() == [1, 1, 1, 1]


def test_step_gradient_is_the_rounding_residual():
    x, step = torch.tensor([0.7, 2.2]), torch.tensor(0.5, requires_grad=True)
    SteRound(step, step_gradient=True).forward(x).sum().backward()
    assert float(step.grad) == pytest.approx((1 - 1.4) + (4 - 4.4), abs=1e-6)
    step.grad = None
    x.requires_grad_()
    SteRound(step).forward(x).sum().backward()
    assert step.grad is None


def test_noise_gradient_flows_into_the_step():
    x = torch.zeros(50, dtype=torch.float64, requires_grad=True)
    step = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    out = add_noise(x, step, torch.rand(50, dtype=torch.float64, generator=gen()))
    out.sum().backward()
    assert float(step.grad) == pytest.approx(float(out.detach().sum()) / 0.5)
    assert (x.grad == 1).all()
    assert out.abs().max() <= 0.25
    uniform = torch.rand(50, dtype=torch.float64, generator=gen())
    assert torch.autograd.gradcheck(lambda a, s: add_noise(a, s, uniform.clone()), (x, step))


def test_indices_stay_near_the_index_of_the_mean():
    x = torch.tensor([0.0] * 99_999 + [1e9])
    mean_index = round(1e4)
    symbols, side = SteRound(1.0).encode(x)
    assert abs(int(symbols.max()) - (mean_index + 15_000)) <= 1
    free, _ = SteRound(4.0, index_clamp=None).encode(x)
    assert int(free.max()) == 250_000_000
    assert torch.equal(SteRound.decode(symbols, side)[:5], x[:5])


@settings(max_examples=40, deadline=None)
@given(st.lists(st.integers(-10_000, 10_000), min_size=1, max_size=30), st.floats(1e-3, 1e3))
def test_rounded_values_are_a_lattice(indices, step):
    symbols = torch.tensor(indices)
    q = SteRound(step, index_clamp=None)
    values = SteRound.decode(symbols, {"step": np.float64(step)})
    assert torch.equal(q.encode(values.double())[0], symbols)


def test_bad_steps_are_refused():
    for step in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="step"):
            SteRound(step).forward(torch.zeros(3))
        with pytest.raises(BitstreamError, match="step"):
            SteRound.decode(torch.zeros(3, dtype=torch.int64), {"step": np.float64(step)})
    for side in ({}, {"step": np.array("x")}, {"step": np.ones(7)}):
        with pytest.raises(BitstreamError):
            SteRound.decode(torch.zeros(3, dtype=torch.int64), side)


def test_binary_by_hand():
    x = torch.tensor([-2.0, -0.5, 0.0, 0.5, 2.0], requires_grad=True)
    out = SteBinary().forward(x)
    assert out.tolist() == [-1, -1, 1, 1, 1]
    out.sum().backward()
    assert x.grad.tolist() == [0, 1, 1, 1, 0]
    assert torch.equal(SteBinary.decode(*SteBinary().encode(x)), out)


def test_mask_by_hand():
    x = torch.tensor([-10.0, 0.0, 3.0], requires_grad=True)
    out = SteMask(0.01).forward(x)
    assert out.tolist() == [0, 1, 1]
    out.sum().backward()
    soft = torch.sigmoid(x.detach())
    assert torch.allclose(x.grad, soft * (1 - soft))
    assert SteMask(0.01).encode(x, weight=torch.tensor([1.0, 0.0, 1.0]))[0].tolist() == [0, 0, 1]


def test_the_limit_of_indices_acts_on_the_index_itself():
    x = torch.cat([torch.linspace(-20_000, 20_000, 4001), torch.tensor([3e6])])
    k0 = round(float(x.double().mean()))
    symbols, _ = SteRound(1.0).encode(x)
    assert (int(symbols.min()), int(symbols.max())) == (k0 - 15_000, k0 + 15_000)
    steps = torch.where(torch.arange(len(x)) % 2 == 0, 1.0, 0.5)  # k0 is one for each step
    symbols, _ = SteRound(steps, index_clamp=100).encode(x)
    assert int(symbols[0::2].max()) == round(float(x.double().mean())) + 100
    assert int(symbols[1::2].max()) == round(float(x.double().mean()) / 0.5) + 100


def test_parts_of_a_tensor_agree_if_they_name_its_mean():
    x = torch.cat([torch.zeros(1000), torch.linspace(0, 40_000, 100)])
    q, mean = SteRound(1.0), x.double().mean()
    whole, side = q.encode(x)
    parts = [q.encode(part, mean=mean)[0] for part in x.split(300)]
    assert torch.equal(torch.cat(parts), whole)
    assert not torch.equal(torch.cat([q.encode(part)[0] for part in x.split(300)]), whole)
    assert torch.equal(q.forward(x), q.decode(whole, side))
    assert torch.equal(torch.cat([q.forward(part, mean=mean) for part in x.split(300)]), q.forward(x))


def test_gradients_where_the_limit_acts():
    x = torch.tensor([0.0, 1.3, 50.0, -50.0], dtype=torch.float64, requires_grad=True)
    step = torch.tensor(1.0, dtype=torch.float64, requires_grad=True)
    SteRound(index_clamp=3, step_gradient=True).forward(x, step).sum().backward()
    assert x.grad.tolist() == [1, 1, 0, 0]
    assert float(step.grad) == pytest.approx((1 - 1.3) + 3 - 3)


@pytest.mark.parametrize("shape", [(), (1,), (4,), (6, 1), (6, 4)])
def test_steps_per_row_group_and_element_learn_from_the_noise(shape):
    x = torch.randn(6, 4, dtype=torch.float64, generator=gen())
    step = (torch.rand(shape, dtype=torch.float64, generator=gen(1)) + 0.5).requires_grad_()
    uniform = torch.rand(6, 4, dtype=torch.float64, generator=gen(2))
    u = uniform - 0.5
    add_noise(x, step, uniform.clone()).sum().backward()
    assert torch.allclose(step.grad, u.sum_to_size(shape))
    assert torch.autograd.gradcheck(lambda a, s: add_noise(a, s, uniform.clone()), (x.requires_grad_(), step))
    q = SteRound()
    symbols, side = q.encode(x, step)
    assert (q.decode(symbols, side) - x).abs().max() <= 0.5 * step.max() + 1e-6


def test_a_step_that_would_enlarge_the_values_is_refused():
    symbols = torch.zeros(3, dtype=torch.int64)
    for step in (np.ones((1000, 1)), np.ones((2, 3)), np.float64(1e300)):
        with pytest.raises(BitstreamError):
            SteRound.decode(symbols + 1, {"step": step})


def test_bits_from_a_file_are_bits():
    for quantizer, values in ((SteBinary, {0: -1, 1: 1}), (SteMask, {0: 0, 1: 1})):
        assert quantizer.decode(torch.tensor([0, 1]), {}).tolist() == list(values.values())
        for bad in (torch.tensor([2]), torch.tensor([-1]), torch.tensor([0.5])):
            with pytest.raises(BitstreamError):
                quantizer.decode(bad, {})


def test_mask_weights_get_their_gradient():
    x = torch.tensor([-1.0, 2.0], dtype=torch.float64, requires_grad=True)
    weight = torch.tensor([0.3, 0.02], dtype=torch.float64, requires_grad=True)
    out = SteMask(0.01).forward(x, weight)
    assert out.tolist() == [1, 1]  # to the bit
    out.sum().backward()
    soft = torch.sigmoid(x.detach())
    assert torch.allclose(x.grad, soft * (1 - soft) * weight.detach())
    assert torch.allclose(weight.grad, soft)


def test_a_mask_that_starts_just_above_its_threshold_is_on():
    # ChimeraGS: sigmoid(-4.5951) = 0.0100002 in float32.
    assert SteMask(0.01).forward(torch.full((3,), -4.5951)).tolist() == [1, 1, 1]
