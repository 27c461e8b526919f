"""Quantiser steps that follow the networks: what pulls at them, and when they begin to."""

import math

import pytest
import torch
from wisp_scenes import made_up

from sw_wisp.context import ContextNetworks
from sw_wisp.numbers import NUMBERS
from sw_wisp.predicting import STEPS_OF
from sw_wisp.pyramid import FEATURES
from sw_wisp.rate_model import Placed, PyramidRate, bits_of
from sw_wisp.rounding import HARD, NOISE, Rounding

APART = 1 / 8
"""Between the middles of two entries of the table of multipliers."""


def constant(t: float, scale: float = 40.0) -> ContextNetworks:
    """Networks that say the same of every splat: mean 0, one scale level, one step output."""
    net = ContextNetworks()
    for network, groups in zip(net.networks, STEPS_OF, strict=True):
        last, steps = network[-1], max(groups) + 1
        with torch.no_grad():
            last.weight.zero_()
            last.bias.zero_()
            last.bias[len(groups) : -steps] = scale
            last.bias[-steps:] = t
    return net


def drawn_by(net, n, phase, seed=0):
    torch.manual_seed(seed)
    features = torch.zeros(n, FEATURES)
    values = torch.randn(n, NUMBERS) * 3 * net.base_steps
    return values, *net(features, features, values, Rounding(phase))


def slopes(net, loss):
    """Of the loss by each of the five step outputs."""
    net.zero_grad()
    loss.backward()
    return torch.cat([network[-1].bias.grad[-max(g) - 1 :] for network, g in zip(net.networks, STEPS_OF, strict=True)])


def by_group(values):
    """Sums of [22] over the columns of opacity, shape, size, colour, latents."""
    return torch.stack([part.sum() for part in values.split([1, 5, 1, 3, 12])])


@pytest.mark.parametrize("phase", [NOISE, HARD])
def test_squared_error_pulls_at_a_step_as_it_grows_with_it(phase):
    t, n = -0.5 + APART / 2, 40_000
    net = constant(t)
    values, forecast, drawn = drawn_by(net, n, phase)
    weights = torch.rand(NUMBERS) / net.base_steps**2
    found = slopes(net, ((drawn - values).square() * weights).sum() / n)
    # w Q^2 / 12, with the slope 1 - tanh^2 of a multiplier.
    steps, slope = forecast.steps[0].detach(), (1 - math.tanh(t) ** 2) * net.base_steps
    assert torch.allclose(found, by_group(weights * steps * slope / 6), rtol=0.03)


def test_bits_pull_at_a_step_as_they_fall_with_it():
    t, n = -0.5 + APART / 2, 20_000
    found = {}
    for place in (t - APART, t, t + APART):
        net = constant(place)
        _, forecast, drawn = drawn_by(net, n, NOISE)
        found[place] = net, bits_of(drawn, forecast).sum(0) / n
    differences = by_group(found[t + APART][1] - found[t - APART][1]).detach() / (2 * APART)
    slope = slopes(found[t][0], found[t][1].sum())
    assert (differences < 0).all()
    assert torch.allclose(slope, differences, rtol=0.05)


def test_networks_fitted_to_numbers_code_them_in_fewer_bits_and_take_the_steps_that_errors_are_worth():
    scene = made_up(600, spread=1.0)
    base = torch.tensor(scene.base_steps)
    rate = PyramidRate(0.5 * base, adaptive=True, generator=torch.Generator().manual_seed(0))
    splats = Placed(scene.values.float(), scene.levels, scene.cells)
    rows = tuple(rate.begin(splats).values())

    rounding = Rounding(NOISE)

    def found():
        torch.manual_seed(1)
        forecast, drawn = rate.predict(rows, splats.values, rounding)
        return forecast.steps / base, bits_of(drawn, forecast).sum(1).mean().item()

    torch.manual_seed(0)
    steps, before = found()
    assert torch.allclose(steps, torch.full_like(steps, 0.5), rtol=0.13)  # entries of the table lie that far apart
    rate.fit(rows, splats.values, rounding, 150, None)
    still, after = found()
    assert after < before - 3
    assert torch.equal(still, steps)
    # With Q far below the deviation, bits fall by 1 / ln 2 for each factor e of Q: least where w Q^2 / 6 is that.
    weights = (6 / math.log(2) / (0.25 * base) ** 2).expand(600, NUMBERS)
    rate.fit(rows, splats.values, rounding, 300, weights)
    assert torch.allclose(found()[0].log().mean(0), torch.tensor(0.25).log(), atol=0.2)
