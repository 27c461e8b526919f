"""The mixed grid of HAC: its integers, its signs, and its kernels against torch operations."""

import pytest
import torch

from splatwizard_core.base.random_states import seeded
from splatwizard_core.plugins import load_plugins
from sw_codecs.exact_native import EXACT
from sw_codecs.native import CODECS
from sw_codecs.testing import check_context_model
from sw_hac.fast import sign_lookup
from sw_hac.mixed_grid import MixedHashGrid

needs_kernels = pytest.mark.skipif(CODECS.available() is not None, reason=str(CODECS.available()))
needs_exact_kernels = pytest.mark.skipif(EXACT.available() is not None, reason=str(EXACT.available()))
ON_CUDA = CODECS.available(cuda=True)
DEVICES = [
    pytest.param("cpu", marks=needs_kernels),
    pytest.param("cuda", marks=[pytest.mark.cuda, pytest.mark.skipif(ON_CUDA is not None, reason=str(ON_CUDA))]),
]


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def places(dimensions, n=700):
    x = torch.rand(n, dimensions, generator=generator(2))
    x[:8] = torch.tensor([0.0, 1.0, -0.5, 1.5, 0.5, 1e-8, 1 - 6e-8, 1e30])[:, None]
    return x


def test_integers_agree_with_floats_at_the_lattice():
    grid = MixedHashGrid((6, 9, 20), (10, 40), features=2, log2_space=9, log2_planes=10, generator=generator())
    for each in grid.grids:
        with torch.no_grad():
            each.table.copy_(torch.randn(each.table.shape, generator=generator(7)))
    codes = torch.randint(0, 65536, (400, 3), generator=generator(8))
    codes[:3] = torch.tensor([[0, 0, 0], [65535, 65535, 65535], [0, 65535, 32768]])
    found = grid.integer_features(codes)
    assert found.dtype == torch.int64
    assert found.shape == (400, 2 * (3 + 3 * 2)) == (400, grid.width)
    floats = grid(codes.double().float() / 65535)
    # Positions are cut to 1/4096 of a cell, results to 1/4096; near the border renormalising magnifies the first.
    difference = (found / 4096 - floats.detach()).abs()
    assert float(difference.quantile(0.99)) < 2e-3
    assert float(difference.median()) < 5e-4


def test_integers_do_not_depend_on_the_batch():
    grid = MixedHashGrid((6, 20), (10,), features=2, log2_space=9, log2_planes=9, generator=generator())
    codes = torch.randint(0, 65536, (97, 3), generator=generator(8))
    whole = grid.integer_features(codes)
    for size in (1, 7, 50):
        assert torch.equal(torch.cat([grid.integer_features(part) for part in codes.split(size)]), whole)


def test_the_published_grid_has_the_published_size():
    grid = MixedHashGrid()
    assert grid.width == 96
    assert [g.table.shape[0] for g in grid.grids] == [95_944, 115_208, 115_208, 115_208]
    assert grid.entries == 1_766_272


def test_signs_survive_the_file():
    grid = MixedHashGrid((6, 9), (10,), features=2, generator=generator(1))
    other = MixedHashGrid((6, 9), (10,), features=2, generator=generator(2))
    signs = grid.signs()
    assert set(signs.tolist()) == {0, 1}
    other.load_signs(signs.numpy())
    x = torch.rand(20, 3, generator=generator(3))
    assert torch.equal(other(x), grid(x))
    with pytest.raises(ValueError, match="signs for"):
        other.load_signs(signs[:-1])


def test_the_rate_of_the_signs_is_that_of_their_share_of_ones():
    grid = MixedHashGrid((6,), (10,), features=2, generator=generator(1))
    with torch.no_grad():
        for each in grid.grids:
            each.table.copy_(torch.rand(each.table.shape, generator=generator(4)) - 0.2)
    _, bits = grid.with_bits(torch.rand(3, 3))
    p = float(grid.signs().double().mean())
    n = grid.entries
    entropy = -n * (p * torch.log2(torch.tensor(p)) + (1 - p) * torch.log2(torch.tensor(1 - p)))
    assert float(bits.detach()) == pytest.approx(float(entropy) + 32, rel=1e-4)
    bits.backward()
    assert all(float(each.table.grad.max()) < 0 for each in grid.grids)  # more ones, fewer bits


def test_it_keeps_the_contract_of_context_models():
    made = MixedHashGrid((6, 10), (10,), features=2, log2_space=8, log2_planes=8)
    check_context_model(made, torch.rand(10, 3, generator=generator()))


def test_it_is_found_by_name():
    assert load_plugins().context_models.load("hash-grid") is MixedHashGrid


@pytest.mark.cuda
def test_cuda_equals_cpu():
    grid = MixedHashGrid((18, 24), (34,), generator=generator(1))
    codes = torch.randint(0, 65536, (500, 3), generator=generator(2))
    features, integers = grid(codes / 65535), grid.integer_features(codes)
    there = grid.cuda()
    torch.testing.assert_close(there(codes.cuda() / 65535).cpu(), features, atol=1e-5, rtol=1e-5)
    assert torch.equal(there.integer_features(codes.cuda()).cpu(), integers)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("features", [1, 2, 4])
def test_signs_and_their_gradients_are_those_of_torch(features, device, monkeypatch):
    grid = MixedHashGrid((6, 9, 34), (10, 66), features=features, log2_space=8, log2_planes=9, generator=generator())
    with torch.no_grad():
        for part in grid.grids:
            part.table.copy_(torch.randn(part.table.shape, generator=generator(1)))
    grid, x = grid.to(device), places(3).to(device)
    weights = torch.randn(len(x), grid.width, generator=generator(3)).to(device)
    assert sign_lookup.fits(grid.parts, x)
    found = []
    for kernel in (True, False):
        monkeypatch.setattr(sign_lookup, "fits", lambda *_, kernel=kernel: kernel)
        features_of, bits = grid.with_bits(x)
        total = (features_of * weights).sum() + 0.5 * bits
        found.append((features_of.detach(), bits.detach(), *torch.autograd.grad(total, [p.table for p in grid.grids])))
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-4)
        assert bool(one.any())
    assert bool((found[0][0][2] == 0).all())  # outside the cube


@needs_kernels
def test_gradients_of_signs_are_the_same_bits_for_any_number_of_threads():
    grid, runs, threads = MixedHashGrid((6, 9), (10, 34), log2_space=8, generator=generator()), [], []
    for count in (1, 3):
        threads.append(torch.get_num_threads())
        torch.set_num_threads(count)
        features, bits = grid.with_bits(places(3))
        runs.append(torch.autograd.grad(features.square().sum() + bits, [part.table for part in grid.grids]))
    torch.set_num_threads(threads[0])
    assert all(torch.equal(a, b) for a, b in zip(*runs, strict=True))


@needs_kernels
def test_places_and_tables_of_signs_that_do_not_fit_are_refused():
    CODECS.load()
    levels = ([2.0], [3], [0], [1], 9)
    look_up, x = torch.ops.sw_codecs.signs_lookup, torch.zeros(2, 3)
    for axes, table, found, first, said in (
        ([0, 3], (16, 2), (2, 2), 0, "no axis 3"),
        ([0, 1], (15, 2), (2, 2), 0, "ends at entry 16 of 15"),
        ([0, 1], (16, 2), (2, 3), 2, "features do not fit"),
        ([0, 1], (16, 2), (1, 2), 0, "features must be contiguous"),
        ([0, 1], (16, 9), (2, 9), 0, "1 to 8"),
    ):
        with pytest.raises(RuntimeError, match=said):
            look_up(x, axes, torch.zeros(table), torch.zeros(found), first, *levels)


@pytest.mark.cuda
@pytest.mark.skipif(ON_CUDA is not None, reason=str(ON_CUDA))
@pytest.mark.parametrize("features", [1, 2, 4, 5])
@pytest.mark.parametrize("slope", [1.0, 1e-12, 1e12])
def test_where_it_is_asked_for_gradients_are_the_same_each_time_and_those_of_the_fast_sums(features, slope):
    """Thousands of places share the entries of a coarse level."""
    grid = MixedHashGrid((6, 9, 34), (10, 66), features=features, log2_space=9, generator=generator()).to("cuda")
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


@needs_exact_kernels
@pytest.mark.parametrize("features", [1, 4, 6, 16])
def test_integers_are_the_same_without_a_kernel(features, monkeypatch):
    grid = MixedHashGrid(
        (6, 18, 33, 9), (10, 130), features=features, log2_space=9, log2_planes=8, generator=generator()
    )
    codes = torch.randint(-3, 65_539, (500, 3), generator=generator(1))
    codes[:4] = torch.tensor([[0, 0, 0], [65_535] * 3, [0, 65_535, 1], [65_536, 5, 5]])
    found = []
    for compiled in (True, False):
        monkeypatch.setattr(type(EXACT), "try_load", lambda _, compiled=compiled: compiled and EXACT.load() is None)
        found += [grid.integer_features(codes), grid.integer_features(codes, torch.int16)]
    assert [each.dtype for each in found] == [torch.int64, torch.int16] * 2
    assert all(torch.equal(each.to(torch.int64), found[0]) for each in found)
