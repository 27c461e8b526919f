"""The kernels of a grid of real numbers against torch operations."""

from __future__ import annotations

import pytest
import torch

from splatwizard_core.base.random_states import seeded
from sw_codecs.context.fast import grid_lookup
from sw_codecs.context.fast.grid_lookup import fits
from sw_codecs.context.hash_grid import HashGrid
from sw_codecs.native import CODECS

needs_kernels = pytest.mark.skipif(CODECS.available() is not None, reason=str(CODECS.available()))
ON_CUDA = CODECS.available(cuda=True)
DEVICES = [
    pytest.param("cpu", marks=needs_kernels),
    pytest.param("cuda", marks=[pytest.mark.cuda, pytest.mark.skipif(ON_CUDA is not None, reason=str(ON_CUDA))]),
]


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def real(dimensions, features, *, finest=3000.0):
    grid = HashGrid.real_grid(
        dimensions, levels=5, features=features, log2_size=9, coarsest=4, finest=finest, generator=generator()
    )
    with torch.no_grad():
        grid.table.copy_(torch.randn(grid.table.shape, generator=generator(1)))
    return grid


def places(dimensions, n=700):
    x = torch.rand(n, dimensions, generator=generator(2))
    x[:8] = torch.tensor([0.0, 1.0, -0.5, 1.5, 0.5, 1e-8, 1 - 6e-8, 1e30])[:, None]
    return x


def both(grid, x, weights):
    found = grid(x)
    (gradient,) = torch.autograd.grad((found * weights).sum(), grid.table)
    return found.detach(), gradient


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dimensions", [2, 3])
@pytest.mark.parametrize("features", [1, 2, 5])
def test_values_and_gradients_are_those_of_torch(dimensions, features, device, monkeypatch):
    grid, x = real(dimensions, features).to(device), places(dimensions).to(device)
    assert 0 < sum(level.dense for level in grid.levels) < 5
    weights = torch.randn(len(x), grid.width, generator=generator(3)).to(device)
    assert fits(grid, x, grid.table)
    found, gradient = both(grid, x, weights)
    monkeypatch.setattr(grid_lookup, "fits", lambda *_: False)
    expected, wanted = both(grid, x, weights)
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)  # a sum of 8 products
    torch.testing.assert_close(gradient, wanted, rtol=1e-4, atol=1e-4)  # of some hundred on a coarse level
    assert gradient.any()


@needs_kernels
def test_gradients_are_the_same_bits_for_any_number_of_threads():
    grid, x = real(3, 2), places(3)
    weights = torch.randn(len(x), grid.width, generator=generator(3))
    runs, threads = [], torch.get_num_threads()
    for count in (1, 2, 3):
        torch.set_num_threads(count)
        runs.append(both(grid, x, weights))
    torch.set_num_threads(threads)
    assert all(torch.equal(a, b) for run in runs[1:] for a, b in zip(runs[0], run, strict=True))


@pytest.mark.parametrize("device", DEVICES)
def test_a_place_that_is_no_number_counts_as_the_corner_of_the_cube(device):
    grid = real(3, 2).to(device)
    x = torch.full((1, 3), torch.nan, device=device)
    assert torch.equal(grid(x), grid(torch.zeros(1, 3, device=device)))


@pytest.mark.parametrize("device", DEVICES)
def test_no_places_have_no_features_and_gradients_of_zero(device):
    grid = real(3, 2).to(device)
    found = grid(torch.zeros(0, 3, device=device))
    assert found.shape == (0, grid.width)


@needs_kernels
def test_what_has_no_kernel_goes_through_torch():
    grid, x = real(3, 2), places(3)[8:].requires_grad_(True)
    assert not fits(grid, x, grid.table)
    assert torch.autograd.grad(grid(x).square().sum(), x)[0].any()
    assert not fits(grid.double(), x.detach().double(), grid.table)
    assert not fits(real(3, 9), x.detach(), grid.table)
    signs = HashGrid.binary_grid(3, (6, 9), features=2, log2_size=12, generator=generator())
    assert not fits(signs, x.detach(), signs.table)


@needs_kernels
@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"scales": [3.0]}, "malformed levels"),
        ({"starts": [0, 500]}, "level 1 ends at entry 564 of 128"),
        ({"starts": [0, -1]}, "level 1 is out of range"),
        ({"lasts": [3, 70_000]}, "level 1 is out of range"),
        ({"scales": [3.0, 90.0]}, "level 1 is out of range"),
    ],
)
def test_levels_that_do_not_fit_the_table_are_refused(change, said):
    CODECS.load()
    levels = {"scales": [3.0, 3.0], "lasts": [3, 3], "starts": [0, 64], "dense": [1, 1], "log2_size": 9, **change}
    with pytest.raises(RuntimeError, match=said):
        torch.ops.sw_codecs.lookup(torch.zeros(1, 3), torch.zeros(128, 2), *levels.values())


@pytest.mark.cuda
@pytest.mark.skipif(ON_CUDA is not None, reason=str(ON_CUDA))
@pytest.mark.parametrize("features", [1, 2, 4, 5])
@pytest.mark.parametrize("slope", [1.0, 1e-12, 1e12])
def test_where_it_is_asked_for_gradients_are_the_same_each_time_and_those_of_the_fast_sums(features, slope):
    """Thousands of places share the entries of a coarse level."""
    grid = real(3, features).to("cuda")
    x = places(3, 20_000).to("cuda")

    def gradients():
        looked_up = grid(x)
        slopes = torch.randn(looked_up.shape, generator=generator(3)).to("cuda") * slope
        return torch.autograd.grad((looked_up * slopes).sum(), list(grid.parameters()))

    fast = gradients()
    with seeded(0, deterministic=True):
        first, *others = (gradients() for _ in range(4))
    for i, (own, atomic) in enumerate(zip(first, fast, strict=True)):
        assert own.any()
        assert all(torch.equal(own, other[i]) for other in others), i
        torch.testing.assert_close(own, atomic, rtol=1e-4, atol=1e-5 * float(atomic.abs().max()))


@pytest.mark.cuda
@pytest.mark.skipif(ON_CUDA is not None, reason=str(ON_CUDA))
@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_ordered_sums_hide_nothing_that_is_not_finite(bad):
    grid, x = real(3, 2).to("cuda"), places(3).to("cuda")
    with seeded(0, deterministic=True):
        features = grid(x)
        slopes = torch.ones_like(features)
        slopes[5, 3] = bad
        (found,) = torch.autograd.grad((features * slopes).sum(), grid.table)
    assert not bool(torch.isfinite(found).all())
