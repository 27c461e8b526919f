"""The colour field: contraction, grid, network."""

import pytest
import torch
from compact_models import field, generator
from sw_compact3dgs.colors import ColorField, contract
from sw_compact3dgs.config import Compact3DGSConfig

from sw_codecs.context.hash_grid import HashGrid

PUBLISHED = {"features": 2, "levels": 16, "coarsest": 16, "growth": 1.447}
CENTER = torch.tensor([0.3, -0.2, -2.0])


def test_the_contraction_by_hand():
    x = torch.tensor([[0.5, 0, 0], [0, 2, 0], [0, 0, -2], [1e15, 0, 0], [0, 0, 0]])
    expected = torch.tensor([[0.625, 0.5, 0.5], [0.5, 0.875, 0.5], [0.5, 0.5, 0.125], [1, 0.5, 0.5], [0.5] * 3])
    torch.testing.assert_close(contract(x), expected)


def test_the_contraction_is_continuous_and_stays_in_the_cube():
    direction = torch.nn.functional.normalize(torch.randn(200, 3, generator=generator(0)), dim=1)
    torch.testing.assert_close(contract(direction * (1 - 1e-6)), contract(direction * (1 + 1e-6)))
    far = contract(direction * 1e6)
    assert bool(((far > 0) & (far < 1)).all())


@pytest.mark.parametrize(("log2_size", "numbers"), [(19, 12_599_920), (16, 1_818_384)])
def test_the_published_grid_has_the_published_number_of_parameters(log2_size, numbers):
    assert ColorField.numbers(**PUBLISHED, log2_size=log2_size) == numbers
    grid = Compact3DGSConfig().grid
    assert (grid.levels, grid.features, grid.coarsest, grid.growth, grid.log2_table) == (16, 2, 16, 1.447, 19)


def test_the_published_resolutions_and_the_count_of_what_is_made():
    made = ColorField(**PUBLISHED, log2_size=8, hidden=64, generator=None)
    resolutions = [level.resolution for level in made.grid.levels]
    assert resolutions[:7] == [16, 24, 34, 49, 71, 102, 147]
    assert resolutions[-1] == 4085
    assert made.grid.table.numel() == ColorField.numbers(**PUBLISHED, log2_size=8)
    assert sum(layer.weight.numel() for layer in made.layers) == 6976


def test_first_values_are_small():
    made = field()
    assert 0 < float(made.grid.table.detach().abs().max()) <= 1e-4


def test_a_dense_level_reproduces_a_linear_function():
    grid = HashGrid.real_grid(3, levels=1, features=1, log2_size=12, coarsest=9, finest=9, generator=None)
    (level,) = grid.levels
    assert level.dense
    cells = torch.cartesian_prod(*[torch.arange(level.resolution)] * 3).flip(1)  # x changes fastest
    places = (cells - 0.5) / level.scale
    slope = torch.tensor([0.3, -1.0, 2.0])
    with torch.no_grad():
        grid.table[: len(cells), 0] = places @ slope + 0.7
    x = torch.rand(50, 3, generator=generator(1)) * 0.9  # past the last vertex its value goes on
    torch.testing.assert_close(grid(x)[:, 0].detach(), x @ slope + 0.7, atol=1e-5, rtol=1e-5)


def test_no_output_is_the_colour_one_half():
    """As degree-0 SH: RGB = max(0, 0.5 + 0.282 out)."""
    made = ColorField(levels=2, features=1, coarsest=4, growth=2.0, log2_size=6, hidden=4, generator=None)
    means = torch.randn(5, 3, generator=generator(0))
    assert bool((made.coefficients(made.features(means), means, CENTER) == 0).all())


def test_gradients_against_finite_differences():
    """Of table, weights and, by way of the direction alone, of positions."""
    made = field().double()
    means = torch.randn(6, 3, generator=generator(0), dtype=torch.float64).requires_grad_()
    with torch.no_grad():
        made.grid.table.copy_(torch.randn(made.grid.table.shape, generator=generator(1)))
    features = made.grid(contract(means.detach()).double()).detach().requires_grad_()

    def of(features, means, *weights):
        old = [layer.weight for layer in made.layers]
        for layer, weight in zip(made.layers, weights, strict=True):
            del layer.weight
            layer.weight = weight
        found = made.coefficients(features, means, CENTER.double())
        for layer, weight in zip(made.layers, old, strict=True):
            del layer.weight
            layer.weight = weight
        return found

    weights = [layer.weight.detach().clone().requires_grad_() for layer in made.layers]
    assert torch.autograd.gradcheck(of, (features, means, *weights), fast_mode=True)

    def of_table(table):
        return made.grid(contract(means.detach()).double(), values=table)

    assert torch.autograd.gradcheck(of_table, (made.grid.table.detach().clone().requires_grad_(),), fast_mode=True)


def test_the_grid_gives_positions_no_gradient():
    made, means = field(), torch.randn(4, 3, generator=generator(0), requires_grad=True)
    found = made.features(means)
    found.sum().backward()
    assert means.grad is None
    assert made.grid.table.grad is not None


def test_many_are_looked_up_in_parts(monkeypatch):
    made, means = field(), torch.randn(50, 3, generator=generator(0))
    whole = made.features(means)
    monkeypatch.setattr("sw_compact3dgs.colors.ROWS", 7)
    assert torch.equal(made.all_features(means), whole.detach())
    assert made.all_features(means[:0]).shape == (0, 8)


def test_a_grid_too_fine_is_refused_before_it_is_made():
    with pytest.raises(ValueError, match="finest level"):
        ColorField.numbers(levels=32, features=1, coarsest=1024, growth=4.0, log2_size=3)
