"""Rate estimates: they sum to one, agree with scipy, stay finite far out, and their gradients point the right way."""

import math

import numpy as np
import pytest
import torch
from scipy import stats

from sw_codecs.entropy import further_rates, rates


def f64(*values):
    return torch.tensor(values, dtype=torch.float64)


CASES = [(rates.gaussian_bits, stats.norm), (further_rates.laplace_bits, stats.laplace)]


@pytest.mark.parametrize(("bits", "family"), CASES)
@pytest.mark.parametrize("scale", [0.05, 0.3, 4.0])
@pytest.mark.parametrize("step", [1.0, 0.25])
def test_probabilities_of_all_bins_sum_to_one(bits, family, scale, step):
    k = torch.arange(-4000, 4001, dtype=torch.float64) * step
    assert float((2 ** -bits(k, 0.37, scale, step, p_min=1e-300)).sum()) == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize(("bits", "family"), CASES)
def test_bits_are_those_of_scipy(bits, family):
    r = np.random.default_rng(0)
    x, mu, scale, step = r.normal(0, 3, 500), r.normal(0, 3, 500), r.uniform(0.3, 4, 500), r.uniform(0.2, 2, 500)
    # Mirrored to the left tail, where scipy's cdf keeps its digits.
    away = -np.abs(x - mu)
    mass = family.cdf(away + step / 2, 0, scale) - family.cdf(away - step / 2, 0, scale)
    found = bits(*(torch.from_numpy(a) for a in (x, mu, scale, step)), p_min=1e-300)
    np.testing.assert_allclose(found.numpy(), -np.log2(mass), rtol=1e-8)


@pytest.mark.parametrize(("bits", "family"), CASES)
@pytest.mark.parametrize("sign", [-1, 1])
def test_stable_forty_scales_out(bits, family, sign):
    x = f64(40.0 * sign).requires_grad_()
    found = bits(x, 0.0, 1.0)
    assert found.item() == pytest.approx(24)
    found.backward()
    assert torch.isfinite(x.grad).all()


@pytest.mark.parametrize(("bits", "family"), CASES)
def test_gradients_are_finite_differences(bits, family):
    r = torch.Generator().manual_seed(0)
    x, mu = (torch.randn(6, generator=r, dtype=torch.float64) for _ in range(2))
    scale, step = (torch.rand(6, generator=r, dtype=torch.float64) + 0.5 for _ in range(2))
    arguments = [a.requires_grad_() for a in (x, mu, scale, step)]
    assert torch.autograd.gradcheck(bits, arguments)


def test_below_the_bound_the_gradient_passes_only_where_descent_raises_p():
    p = f64(0.5, 1e-9, 1e-9).requires_grad_()
    rates.lower_bound(p, 1e-6).backward(f64(3.0, -1.0, 1.0))
    assert p.grad.tolist() == [3.0, -1.0, 0.0]
    p.grad = None
    rates.lower_bound(p, 1e-6, grad_below_bound=False).backward(f64(3.0, -1.0, 1.0))
    assert p.grad.tolist() == [3.0, 0.0, 0.0]
    p.grad = None
    found = rates.lower_bound(p, f64(0.1, 0.2, 0.7))  # a bound for each
    found.backward(f64(3.0, -1.0, 1.0))
    assert found.tolist() == [0.5, 0.2, 0.7]
    assert p.grad.tolist() == [3.0, -1.0, 0.0]


def test_an_outlier_is_pulled_towards_the_mean():
    # p is below the bound, but not so small that its own gradient underflows.
    x = f64(6.0).requires_grad_()
    rates.gaussian_bits(x, 0.0, 1.0, p_min=1e-6).backward()
    assert float(x.grad) > 0  # descent lowers x
    x.grad = None
    rates.gaussian_bits(x, 0.0, 1.0, p_min=1e-6, grad_below_bound=False).backward()
    assert float(x.grad) == 0


def test_bernoulli_and_categorical_by_hand():
    assert further_rates.bernoulli_bits(f64(1, 0), 0.25).tolist() == pytest.approx([2, -math.log2(0.75)], rel=1e-12)
    assert float(further_rates.bernoulli_bits(f64(1), 0.0)) == pytest.approx(-math.log2(1e-6), rel=1e-12)
    assert torch.isfinite(further_rates.bernoulli_bits(torch.ones(1, dtype=torch.float16), 1.0)).all()
    logits = torch.log(f64(0.5, 0.25, 0.25)).expand(3, 3)
    assert further_rates.categorical_bits(torch.arange(3), logits).tolist() == pytest.approx([1, 2, 2])


def test_mask_bits_count_ones_and_the_stored_share():
    mask = f64(1, 0, 0, 0)
    expected = 2 * 1 + 3 * -math.log2(0.75) + 32
    assert float(rates.mask_bits(mask)) == pytest.approx(expected)
    mask.requires_grad_()
    rates.mask_bits(mask).backward()
    assert (mask.grad > 0).all()  # fewer than half are ones: one more costs more


@pytest.mark.parametrize("grad_below_bound", [True, False])
def test_the_gradient_of_gaussian_bits_is_that_of_its_parts(grad_below_bound):
    g = torch.Generator().manual_seed(0)
    x, mu = (torch.randn(40, 6, generator=g, dtype=torch.float64) for _ in range(2))
    x[:4] *= 30  # far out: below the bound
    sigma = torch.rand(40, 6, generator=g, dtype=torch.float64) + 0.02
    step = torch.rand(40, 1, generator=g, dtype=torch.float64) + 0.1
    weights = torch.randn(40, 6, generator=g, dtype=torch.float64)
    leaves = [t.requires_grad_() for t in (x, mu, sigma, step)]
    found = rates.gaussian_bits(*leaves, p_min=1e-6, grad_below_bound=grad_below_bound)
    expected = rates.bits_of(rates.gaussian_mass(*leaves), 1e-6, grad_below_bound)
    torch.testing.assert_close(found, expected)
    assert float(found.detach().max()) == pytest.approx(19.93, abs=0.01)
    for a, b in zip(*(torch.autograd.grad((each * weights).sum(), leaves) for each in (found, expected)), strict=True):
        torch.testing.assert_close(a, b)


def test_a_mixture_sums_to_one_and_is_that_of_scipy():
    logits, mean, scale = f64(0.5, 0.0, -2.0), f64(-4.0, 1.5, 0.0), f64(0.4, 1.0, 9.0)
    k = np.arange(-4000, 4001)
    p = 2 ** -further_rates.mixture_bits(torch.from_numpy(k * 0.25), logits, mean, scale, 0.25, p_min=1e-300)
    assert float(p.sum()) == pytest.approx(1, abs=1e-6)
    near = np.abs(k) < 40
    expected = sum(
        w * (stats.norm.cdf(k * 0.25 + 0.125, m, s) - stats.norm.cdf(k * 0.25 - 0.125, m, s))
        for w, m, s in zip(torch.softmax(logits, 0).numpy(), mean.numpy(), scale.numpy(), strict=True)
    )
    np.testing.assert_allclose(p.numpy()[near], expected[near], rtol=1e-8)


def test_a_mixture_of_one_is_its_component_and_trains():
    x = torch.linspace(-6, 6, 31, dtype=torch.float64)
    one = further_rates.mixture_bits(x, f64(0.3), f64(0.5), f64(2.0), 0.5)
    torch.testing.assert_close(one, rates.gaussian_bits(x, 0.5, 2.0, 0.5))
    arguments = [a.requires_grad_() for a in (x[:4].clone(), f64(0.1, 0.4), f64(0.5, -1.0), f64(2.0, 0.7))]
    assert torch.autograd.gradcheck(lambda *a: further_rates.mixture_bits(*a, 0.5), arguments)
    far = further_rates.mixture_bits(f64(40.0), f64(0.0, 0.0), f64(0.0, 0.0), f64(1.0, 1.0))
    assert far.item() == pytest.approx(24)
