"""Colour coordinates and the appearance network."""

import pytest
import torch

from sw_wisp.appearance import AppearanceNetwork, colour_of, sh_dc_of
from sw_wisp.eight_bits import rounded_weights


def test_colour_comes_back_and_is_orthonormal() -> None:
    dc = torch.randn(50, 1, 3, dtype=torch.float64)
    colour = colour_of(dc)
    assert torch.allclose(sh_dc_of(colour), dc)
    grey = colour_of(torch.zeros(1, 1, 3, dtype=torch.float64))  # 0.5, 0.5, 0.5
    assert torch.allclose(grey, torch.tensor([[0.75**0.5, 0, 0]], dtype=torch.float64))


def test_network_has_2537_numbers() -> None:
    assert sum(p.numel() for p in AppearanceNetwork().parameters()) == 2_537


def test_splats_without_latents_look_the_same_from_every_side_at_first() -> None:
    network = AppearanceNetwork(generator=torch.Generator().manual_seed(0))
    assert not network(torch.zeros(4, 12), torch.rand(4, 3)).any()


def test_fit_reproduces_what_has_twelve_dimensions() -> None:
    draws = torch.Generator().manual_seed(0)
    rest = (torch.randn(300, 12, generator=draws) @ torch.randn(12, 45, generator=draws) + 0.3).view(300, 15, 3)
    network = AppearanceNetwork()
    latents = network.fit(rest, torch.rand(300, generator=draws) + 0.1)
    assert torch.allclose(network(latents, torch.rand(300, 3)), rest, atol=1e-4)
    assert torch.allclose(network.basis.T @ network.basis, torch.eye(12), atol=1e-5)


def test_fit_prefers_what_weighs_more() -> None:
    rest = torch.zeros(4, 15, 3)
    rest[0, 0, 0], rest[1, 0, 0] = 1.0, -1.0
    rest[2, 1, 0], rest[3, 1, 0] = 1.0, -1.0
    network = AppearanceNetwork(latents=1)
    network.fit(rest, torch.tensor([1.0, 1.0, 0.1, 0.1]))
    assert network.basis.abs().argmax() == 0


def test_rounded_network_is_the_one_of_the_file() -> None:
    draws = torch.Generator().manual_seed(5)
    network = AppearanceNetwork(generator=draws)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=draws))
        network.basis[0, 0] = 40.0  # one large weight must not cost the rest of its row
    latents, colour = torch.randn(30, 12, generator=draws), torch.rand(30, 3, generator=draws)
    network.rounds = True
    again = AppearanceNetwork.of_layers(network.layers(), 3)
    assert torch.allclose(network(latents, colour), again(latents, colour), atol=2e-3)  # biases of 16 bits
    for name in ("basis", "hidden.weight", "out.weight"):
        assert torch.equal(rounded_weights(network.get_parameter(name)), again.get_parameter(name))


def test_layers_that_do_not_fit_are_refused() -> None:
    layers = AppearanceNetwork().layers()
    with pytest.raises(ValueError, match="no appearance network"):
        AppearanceNetwork.of_layers(layers, 2)
