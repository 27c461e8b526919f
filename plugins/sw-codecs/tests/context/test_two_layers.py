"""Small networks: how they start, from their own generator alone."""

import pytest
import torch
from torch import nn

from sw_codecs.context.two_layers import two_layers


def made(seed=0, **options):
    return two_layers(400, 300, 50, torch.Generator().manual_seed(seed), **options)


@pytest.mark.parametrize(("start", "bounds"), [("fan-in", (1 / 20, 300**-0.5)), ("silent", (1 / 20, 0.0)),
                                               ("xavier", ((6 / 700) ** 0.5, (6 / 350) ** 0.5))])  # fmt: skip
def test_weights_fill_their_bounds(start, bounds):
    first, _, last = made(start=start)
    for layer, bound in zip((first, last), bounds, strict=True):
        assert 0.99 * bound <= float(layer.weight.detach().abs().max()) <= bound
        largest = float(layer.bias.detach().abs().max())
        assert largest == 0 if start == "xavier" else 0.9 * bound <= largest <= bound
        assert layer.weight.requires_grad


def test_the_generator_alone_decides():
    before = torch.get_rng_state()
    one, same, other = (nn.utils.parameters_to_vector(made(seed).parameters()) for seed in (1, 1, 2))
    assert torch.equal(one, same)
    assert not torch.equal(one, other)
    assert torch.equal(torch.get_rng_state(), before)


def test_the_activation_is_relu_unless_another_is_given():
    assert isinstance(made()[1], nn.ReLU)
    assert made(activation=nn.LeakyReLU(0.01))[1].negative_slope == 0.01
