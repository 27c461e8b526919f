"""Bits of a sample of anchors on the CPU: the kernel against torch operations in float64; and draws for noise."""

import pytest
import torch
from sw_anchors import rate_model
from sw_anchors.fast import sample_bits
from sw_anchors.noisy_values import draws


def inputs(count, features, k, spread=1.0):
    g = torch.Generator().manual_seed(0)
    numbers = features + 6 + 3 * k
    x, mean = (spread * torch.randn(count, numbers, generator=g) for _ in range(2))
    scale = torch.rand(count, numbers, generator=g) * 1.5 - 0.3  # some of them below the floor
    steps = torch.rand(count, 3, generator=g) + 0.5
    masks, counted = (torch.rand(shape, generator=g).lt(0.7).float() for shape in ((count, k), (count,)))
    return [x, mean, scale, steps, masks], counted


def found_by(tensors, counted, dtype, smallest_scale=0.4):
    """float64 has no kernel."""
    leaves = [t.to(dtype).requires_grad_() for t in tensors]
    form = sample_bits if sample_bits.fits(*leaves) else rate_model
    bits, by_group = form.bits_of(*leaves, counted.to(dtype), 1e-6, smallest_scale)
    return [bits.detach(), by_group, *torch.autograd.grad(0.5 * bits, leaves)]


@pytest.mark.parametrize(("count", "features", "k"), [(0, 24, 8), (1, 5, 1), (70, 24, 8), (33, 50, 10)])
def test_the_kernel_equals_the_operators(count, features, k):
    results = [found_by(*inputs(count, features, k), dtype) for dtype in (torch.float32, torch.float64)]
    for a, b in zip(*results, strict=True):
        # A probability is a difference of two numbers of float32's precision, 1e-4 of it where it is near its floor.
        torch.testing.assert_close(a.double(), b, atol=1e-3, rtol=1e-3)


def test_a_probability_below_its_floor_keeps_its_bits_and_the_gradient_that_raises_it():
    tensors, counted = inputs(4, 5, 1)
    x, _, scale = (t.zero_() for t in tensors[:3])
    x[:, 0], scale[:] = 3.0, 0.5  # a bin of width 0.5, from 5.5 deviations on
    tensors[3].fill_(0.5)
    counted.fill_(1), tensors[4].fill_(1)
    _, by_group, to_x, to_mean, *_ = found_by(tensors, counted, torch.float32)
    assert by_group[0] > 4 * 19.9  # of 1e-6
    assert (to_x[:, 0] > 0).all()
    assert torch.equal(to_x, -to_mean)


@pytest.mark.parametrize("which", [0, 1, 2])
def test_a_nan_is_not_hidden(which):
    tensors, counted = inputs(2, 5, 1)
    tensors[which][0, 0] = float("nan")
    counted.fill_(1)
    for dtype in (torch.float32, torch.float64):
        assert found_by(tensors, counted, dtype)[0].isnan()


def test_anchors_that_do_not_count_cost_nothing():
    tensors, counted = inputs(9, 7, 2)
    tensors[4].zero_(), counted.zero_()
    bits, _, *slopes = found_by(tensors, counted, torch.float32)
    assert bits == 0
    assert all((slope == 0).all() for slope in slopes[:4])
    assert (slopes[4] > 0).all()  # what a mask would cost if it were on


def test_draws_for_noise_are_uniform_and_their_generators():
    found = draws((300, 101), torch.Generator().manual_seed(1), torch.device("cpu"))
    again = draws((300, 101), torch.Generator().manual_seed(1), torch.device("cpu"))
    assert torch.equal(found, again)
    assert found.shape == (300, 101)
    assert 0 < found.min() < 1e-3
    assert 1 - 1e-3 < found.max() < 1
    for lane in range(4):  # of the integers that hold four draws each
        values = found.flatten()[lane::4].sort().values
        distance = (values - torch.linspace(0, 1, len(values))).abs().max()
        assert distance < 1.95 / len(values) ** 0.5  # Kolmogorov and Smirnov, one in a thousand
