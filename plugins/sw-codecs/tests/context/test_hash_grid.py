"""The hash grid against a direct trilinear oracle, and its integer twin."""

import itertools

import pytest
import torch

from sw_codecs.context.hash_grid import HashGrid


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def binary(dimensions=3, resolutions=(6, 9), *, features=3, log2_size=12, seed=0):
    grid = HashGrid.binary_grid(
        dimensions, resolutions, features=features, log2_size=log2_size, generator=generator(seed)
    )
    with torch.no_grad():
        grid.table.copy_(torch.randn(grid.table.shape, generator=generator(seed + 1)))
    return grid


def hashed(p):
    h = 0
    for coordinate, prime in zip(p, (1, 2654435761, 805459861), strict=False):
        h ^= (coordinate * prime) % 2**32
    return h


def oracle(grid, x):
    """One point, in plain python."""
    out = []
    values = grid.table.detach().double()
    if grid.binary:
        values = torch.where(values >= 0, 1.0, -1.0).double()
    for level in grid.levels:
        r, d = level.resolution, grid.dimensions
        place = [float(c) * level.scale + 0.5 for c in x]
        cell = [int(p // 1) for p in place]
        total, weights = torch.zeros(grid.features, dtype=torch.float64), 0.0
        for corner in itertools.product((0, 1), repeat=d):
            weight = 1.0
            for c, p, q in zip(corner, place, cell, strict=True):
                weight *= (p - q) if c else 1 - (p - q)
            p = [q + c for q, c in zip(cell, corner, strict=True)]
            if grid.binary and any(c in (0, r - 1) for c in p):
                continue
            p = [min(c, r - 1) for c in p]
            index = sum(c * r**i for i, c in enumerate(p)) if r**d <= level.size else hashed(p) % level.size
            total += weight * values[level.start + index]
            weights += weight
        if grid.binary:
            outside = any(not 0 <= float(c) <= 1 for c in x)
            total = total / weights if weights > 0 and not outside else total * 0
        out.append(total)
    return torch.cat(out)


@pytest.mark.parametrize("dimensions", [2, 3])
@pytest.mark.parametrize("log2_size", [12, 5])
def test_a_binary_grid_equals_the_oracle(dimensions, log2_size):
    grid = binary(dimensions, log2_size=log2_size)
    assert any(level.dense for level in grid.levels) == (log2_size == 12)
    x = torch.cat([torch.rand(60, dimensions, generator=generator(2)), torch.tensor([[0.0] * dimensions]),
                   torch.tensor([[1.0] * dimensions]), torch.tensor([[0.0, 1.0, 0.5][:dimensions]])])  # fmt: skip
    expected = torch.stack([oracle(grid, point) for point in x])
    torch.testing.assert_close(grid(x).double(), expected, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("dimensions", [2, 3])
def test_a_real_grid_equals_the_oracle(dimensions):
    grid = HashGrid.real_grid(
        dimensions, levels=4, features=2, log2_size=8, coarsest=4, finest=40, generator=generator()
    )
    assert [level.resolution for level in grid.levels] == [4, 9, 19, 40]
    assert float(grid.table.detach().abs().max()) <= 1e-4
    with torch.no_grad():
        grid.table.copy_(torch.randn(grid.table.shape, generator=generator(1)))
    x = torch.cat(
        [torch.rand(60, dimensions, generator=generator(2)), torch.zeros(1, dimensions), torch.ones(1, dimensions)]
    )
    expected = torch.stack([oracle(grid, point) for point in x])
    torch.testing.assert_close(grid(x).double(), expected, atol=1e-5, rtol=1e-5)


def test_border_vertices_do_not_count():
    grid = binary(resolutions=(6,), features=1)
    signs = torch.where(grid.table.detach() >= 0, 1.0, -1.0).view(6, 6, 6)  # z, y, x
    # x = 0 is half way between the border vertex 0 and vertex 1, which has all the weight that is left.
    torch.testing.assert_close(grid(torch.zeros(1, 3)).detach()[0, 0], signs[1, 1, 1])
    torch.testing.assert_close(grid(torch.ones(1, 3)).detach()[0, 0], signs[4, 4, 4])
    with torch.no_grad():
        border = torch.ones(6, 6, 6, dtype=torch.bool)
        border[1:5, 1:5, 1:5] = False
        before = grid(torch.rand(50, 3, generator=generator(3)))
        grid.table.view(6, 6, 6)[border] *= -1
        after = grid(torch.rand(50, 3, generator=generator(3)))
    assert torch.equal(before, after)


def test_outside_the_box_features_and_gradients_are_zero():
    grid = binary()
    x = torch.tensor([[-1e-6, 0.5, 0.5], [0.5, 1.0001, 0.5], [7.0, 0.5, -3.0]])
    found = grid(x)
    assert not bool(found.any())
    found.sum().backward()
    assert not bool(grid.table.grad.any())


def test_no_points_have_no_features():
    assert binary()(torch.zeros(0, 3)).shape == (0, 6)
    assert binary().integer_features(torch.zeros(0, 3, dtype=torch.int64)).shape == (0, 6)


def test_the_table_learns_inside_the_window_of_the_sign():
    grid = binary(resolutions=(6,), features=1)
    with torch.no_grad():
        grid.table[:] = 0.5
        grid.table[1 + 6 + 36] = 1.5
    grid(torch.zeros(1, 3)).sum().backward()
    assert not bool(grid.table.grad.any())  # the one vertex that counts is beyond 1
    with torch.no_grad():
        grid.table[1 + 6 + 36] = -0.9
    grid(torch.zeros(1, 3)).sum().backward()
    assert torch.nonzero(grid.table.grad).tolist() == [[1 + 6 + 36, 0]]


@pytest.mark.parametrize("kind", ["binary", "real"])
def test_gradients_are_those_of_finite_differences(kind):
    if kind == "binary":
        grid = binary(resolutions=(6, 9), features=2, log2_size=6).double()
    else:
        grid = HashGrid.real_grid(levels=2, coarsest=4, finest=9, log2_size=6, generator=generator()).double()
    # Away from cell borders, where a multilinear function has corners.
    x = (torch.rand(5, 3, generator=generator(4), dtype=torch.float64) * 0.6 + 0.2).requires_grad_()
    values = torch.randn(grid.table.shape, generator=generator(5), dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(lambda x, values: grid(x, values), (x, values), eps=1e-7, atol=1e-5)


def test_grids_that_make_no_sense_are_refused():
    with pytest.raises(ValueError, match="3 or more"):
        HashGrid.binary_grid(3, (2,), features=1, log2_size=4, generator=generator())
    with pytest.raises(ValueError, match="2 or 3 axes"):
        HashGrid.binary_grid(1, (5,), features=1, log2_size=4, generator=generator())
    with pytest.raises(ValueError, match="out of range"):
        HashGrid.binary_grid(3, (1 << 17,), features=1, log2_size=4, generator=generator())
    with pytest.raises(ValueError, match="binary"):
        HashGrid.real_grid(levels=1, generator=generator()).integer_features(torch.zeros(1, 3, dtype=torch.int64))
