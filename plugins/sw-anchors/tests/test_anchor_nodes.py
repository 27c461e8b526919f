"""The parts of an anchor model that are one node of the graph each, against the same written out."""

import copy

import pytest
import torch
from sw_anchors import neural_gaussians, stage
from sw_anchors.fast import loss, spawn
from sw_anchors.fast import noisy_values as fast_values
from sw_anchors.fast.fixed_step import bernoulli_rows, sample_capacity
from sw_anchors.fast.rows import take_rows
from sw_anchors.native import ANCHORS
from sw_anchors.noisy_values import Noise, noisy_values

from splatwizard_core.base.random_states import seeded
from sw_codecs.context.two_layers import two_layers

needs_kernels = pytest.mark.skipif(ANCHORS.available() is not None, reason=str(ANCHORS.available()))
PARTS = ("means", "opacities", "scales", "quats", "colors", "all_opacities", "alphas", "drawn")


def of_dtype(dtype, center, tensors, masks, networks):
    """Leaves of the dtype, and the arguments of `spawn` made of them."""
    tensors = [t.detach().to(dtype).requires_grad_(t.requires_grad) for t in tensors]
    masks = None if masks is None else masks.detach().to(dtype).requires_grad_()
    networks = tuple(copy.deepcopy(network).to(dtype) for network in networks)
    parameters = [p for network in networks for p in network.parameters()]
    leaves = [t for t in (*tensors, *([] if masks is None else [masks])) if t.requires_grad] + parameters
    return leaves, (center.to(dtype), *tensors, masks, networks)


def gradients(found, leaves, generator):
    """Of a random combination of the first five."""
    total = sum((f * torch.randn(f.shape, generator=generator).to(f)).sum() for f in found[:5])
    return torch.autograd.grad(total, leaves)


@needs_kernels
@pytest.mark.parametrize("masked", [True, False])
@pytest.mark.parametrize("learns", [True, False])
@pytest.mark.parametrize("n", [250, 0])
def test_spawning_by_kernels_equals_the_plain_form(masked, learns, n):
    """With positions that learn, networks and Gaussians are apart; else on the CPU they are one kernel."""
    g, k, width = torch.Generator().manual_seed(0), 5, 7
    networks = tuple(two_layers(width + 4, 6, out * k, g) for out in (1, 7, 3))
    masks = (torch.rand(n, k, generator=g) > 0.3).float() if masked else None
    tensors = [torch.randn(size, generator=g).requires_grad_() for size in ((n, 3), (n, width), (n, k, 3), (n, 6))]
    tensors[0].requires_grad_(learns)
    given = torch.tensor([0.3, -2.0, 5.0]), tensors, masks, networks
    pairs = []
    for form, dtype in ((spawn.spawn, torch.float32), (neural_gaussians.spawn, torch.float64)):
        leaves, arguments = of_dtype(dtype, *given)
        assert spawn.fits(*arguments[1:-1]) == (dtype == torch.float32)
        found = form(*arguments)
        found = [getattr(found, name) for name in PARTS]
        pairs.append([*found, *gradients(found, leaves, torch.Generator().manual_seed(1))])
    for a, b in zip(*pairs, strict=True):
        torch.testing.assert_close(a.to(b.dtype), b, atol=1e-4, rtol=1e-4)  # float32 sums over 250 rows


@needs_kernels
@pytest.mark.parametrize("threads", [2, 5])
def test_one_kernel_gives_the_same_bits_on_any_number_of_threads(threads):
    g, n, k = torch.Generator().manual_seed(0), 3000, 8
    networks = tuple(two_layers(28, 48, out * k, g) for out in (1, 7, 3))
    tensors = [torch.randn(size, generator=g) for size in ((n, 3), (n, 24), (n, k, 3), (n, 6))]
    before, found = torch.get_num_threads(), []
    try:
        for count in (1, threads):
            torch.set_num_threads(count)
            leaves = [t.clone().requires_grad_() for t in tensors[1:]]
            spawned = spawn.spawn(torch.zeros(3), tensors[0], *leaves, None, networks)
            parts = (spawned.means, spawned.opacities, spawned.scales, spawned.quats, spawned.colors)
            learning = [*leaves, *(p for network in networks for p in network.parameters())]
            total = sum((part * part).flatten()[:: i + 2].sum() for i, part in enumerate(parts))
            found.append([*parts, *torch.autograd.grad(total, learning)])
    finally:
        torch.set_num_threads(before)
    assert len(spawned.drawn) > n  # on threads indeed
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))


@needs_kernels
def test_gradients_of_networks_are_aligned_for_the_optimizer():
    g, k = torch.Generator().manual_seed(0), 2
    networks = tuple(two_layers(9, 5, out * k, g) for out in (1, 7, 3))  # 45 weights in each first layer
    tensors = (torch.randn(size, generator=g) for size in ((6, 3), (6, 5), (6, k, 3), (6, 6)))
    found = spawn.spawn(torch.zeros(3), *tensors, None, networks)
    (found.means.sum() + found.opacities.sum() + found.scales.sum() + found.colors.sum()).backward()
    for network in networks:
        for parameter in network.parameters():
            assert parameter.grad.is_contiguous()
            assert parameter.grad.data_ptr() % 16 == 0


@pytest.mark.parametrize("weighted", [True, False])
def test_values_and_masks_equal_indexing(weighted):
    g, n, k = torch.Generator().manual_seed(0), 9, 2
    leaves = [torch.randn(size, generator=g, dtype=torch.float64).requires_grad_()
              for size in ((n, 4), (n, 6), (n, k, 3), (n, k))]  # fmt: skip
    features, log_scales, offsets, logits = leaves
    weights = torch.rand(n, 1, generator=g, dtype=torch.float64) if weighted else None
    rows = torch.tensor([7, 0, 3, 8])
    values = noisy_values(rows, tuple(leaves), weights, 0.4, None, torch.tensor([1, 3]))
    found = torch.cat([values.features, values.scales, values.offsets.flatten(1)], dim=1)
    soft = torch.sigmoid(logits)[rows] * (weights[rows] if weighted else 1)
    expected = torch.cat([features[rows], log_scales[rows].exp(), offsets[rows].flatten(1)], dim=1)
    torch.testing.assert_close(found, expected)
    torch.testing.assert_close(values.sample, expected[[1, 3]])
    assert torch.equal(values.masks, (soft > 0.4).to(soft))
    to_values, to_masks = torch.randn(found.shape, generator=g).double(), torch.randn(4, k, generator=g).double()
    found = torch.autograd.grad((found * to_values).sum() + (values.masks * to_masks).sum(), leaves)
    right = torch.autograd.grad((expected * to_values).sum() + (soft * to_masks).sum(), leaves)
    for a, b in zip(found, right, strict=True):
        torch.testing.assert_close(a, b)


@needs_kernels
@pytest.mark.parametrize("weighted", [True, False])
@pytest.mark.parametrize("steps", ["none", "of all", "of each"])
def test_noisy_values_of_the_kernel_equal_the_plain_form(weighted, steps):
    g, n, k = torch.Generator().manual_seed(0), 700, 3
    tables = [torch.randn(size, generator=g) for size in ((n, 5), (n, 6), (n, k, 3), (n, k))]
    rows = torch.randperm(n, generator=g)[:600]
    drawn = torch.nonzero(torch.rand(600, generator=g) < 0.1).squeeze(1)
    weights = torch.rand(n, 1, generator=g) if weighted else None
    step = torch.rand((1, 3) if steps == "of all" else (600, 3), generator=g)
    uniform, slopes = torch.rand(600, 5 + 6 + 3 * k, generator=g), torch.randn(600, 5 + 6 + 4 * k, generator=g)
    found = []
    for form, dtype in ((fast_values.noisy_values, torch.float32), (noisy_values, torch.float64)):
        leaves = [t.to(dtype).requires_grad_() for t in tables]
        own = step.to(dtype).requires_grad_(steps == "of each")
        noise = None if steps == "none" else Noise(own, uniform.to(dtype))
        own_weights = None if weights is None else weights.to(dtype)
        assert fast_values.fits(tuple(leaves), own_weights) == (dtype == torch.float32)
        values = form(rows, tuple(leaves), own_weights, 0.4, noise, drawn)
        parts = [values.features, values.scales, values.offsets.flatten(1), values.masks]
        total = (torch.cat(parts, dim=1) * slopes.to(dtype)).sum() + values.sample.square().sum()
        learning = [*leaves, *([own] if steps == "of each" else [])]
        found.append([*parts, values.sample, *torch.autograd.grad(total, learning)])
    for a, b in zip(*found, strict=True):
        torch.testing.assert_close(a.double(), b.double(), atol=2e-5, rtol=2e-5)  # exp in float32


def test_rows_and_products_have_their_gradients():
    g = torch.Generator().manual_seed(0)
    a, b, scales = (torch.randn(n, 3, generator=g, dtype=torch.float64).requires_grad_() for n in (6, 6, 5))
    rows = torch.tensor([4, 1, 5])
    assert all(torch.equal(x, y[rows]) for x, y in zip(take_rows(rows, a, b), (a, b), strict=True))
    assert torch.autograd.gradcheck(lambda x, y: take_rows(rows, x, y), (a, b))
    for mean_product in (loss.mean_product, stage.mean_product):
        for count in (7, torch.tensor(7)):
            torch.testing.assert_close(mean_product(scales, count), scales.prod(dim=1).sum() / 7)
            assert torch.autograd.gradcheck(mean_product, (scales, count))
        assert float(mean_product(torch.zeros(0, 3), 1)) == 0


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_spawning_on_a_gpu_equals_spawning_on_the_cpu():
    g, n, k = torch.Generator().manual_seed(0), 300, 5
    networks = tuple(two_layers(11, 6, out * k, g) for out in (1, 7, 3))
    tensors = [torch.randn(size, generator=g) for size in ((3,), (n, 3), (n, 7), (n, k, 3), (n, 6))]
    masks = (torch.rand(n, k, generator=g) > 0.3).float()
    found = []
    for device in ("cpu", "cuda"):
        moved = tuple(network.to(device) for network in networks)
        leaves = [t.to(device).requires_grad_() for t in (*tensors[1:], masks)]
        assert spawn.fits(*leaves)
        spawned = spawn.spawn(tensors[0].to(device), *leaves, moved)
        leaves += [p for network in moved for p in network.parameters()]
        parts = (spawned.means, spawned.opacities, spawned.scales, spawned.quats, spawned.colors)
        gradients = torch.autograd.grad(sum(part.square().mean() for part in parts), leaves)
        found.append([each.detach().cpu() for each in (*parts, *gradients)])
    for a, b in zip(*found, strict=True):
        torch.testing.assert_close(a, b, atol=1e-4, rtol=1e-3)


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_where_it_is_asked_for_gradients_of_an_anchor_are_the_same_each_time_and_those_of_the_cpu():
    g, n, k = torch.Generator().manual_seed(0), 3000, 10
    tensors = [torch.randn(size, generator=g) for size in ((n, k), (n, 7 * k), (n, 3 * k), (n, 3), (n, k, 3), (n, 6))]
    masks = (torch.rand(n, k, generator=g) > 0.3).float()

    def gradients(device):
        leaves = [t.to(device).requires_grad_() for t in (*tensors, masks)]
        assert spawn.fits(*leaves)
        found = spawn.visible_gaussians(*leaves)
        parts = (found.means, found.opacities, found.scales, found.quats, found.colors)
        return torch.autograd.grad(sum(part.pow(3).sum() for part in parts), leaves)

    with seeded(0, deterministic=True):
        first, *others = (gradients("cuda") for _ in range(4))
    for i, (own, wanted) in enumerate(zip(first, gradients("cpu"), strict=True)):
        assert all(torch.equal(own, other[i]) for other in others), i
        torch.testing.assert_close(own.cpu(), wanted, rtol=1e-4, atol=1e-5 * float(wanted.abs().max()))


@pytest.mark.parametrize("share", [0.0, 0.05, 0.7, 1.0])
def test_a_sample_of_all_rows_draws_each_with_its_probability(share):
    n, g = 4000, torch.Generator().manual_seed(0)
    size = sample_capacity(n, share)
    found = torch.zeros(n)
    for _ in range(50):
        rows, counted = bernoulli_rows(torch.rand(size, generator=g), n, share)
        drawn = rows[counted > 0]
        assert len(drawn.unique()) == len(drawn)
        assert bool((rows[counted == 0] == n - 1).all())
        found[drawn] += 1
    spread = (share * (1 - share) * 50) ** 0.5
    assert abs(float(found.mean()) - 50 * share) <= 4 * spread / n**0.5 + 1e-6
    assert float(found.std()) == pytest.approx(spread, rel=0.05, abs=1e-6)  # rows are drawn independently


@pytest.mark.parametrize("weighted_sum", [loss.weighted_sum, stage.weighted_sum])
def test_a_weighted_sum_is_the_sum_of_products(weighted_sum):
    start, a, b = (torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in (0.3, -2.0, 5.0))
    total, *parts = weighted_sum(start, (0.5, a), (-3.0, b))
    assert float(total.detach()) == pytest.approx(0.3 - 1 - 15)
    assert [float(part) for part in parts] == [-1, -15]
    assert total.requires_grad
    assert not any(part.requires_grad for part in parts)
    assert torch.autograd.gradcheck(lambda *x: weighted_sum(x[0], (0.5, x[1]), (-3.0, x[2]))[0], (start, a, b))
    alone = weighted_sum(start)
    assert len(alone) == 1
    alone[0].backward()
    assert float(start.grad) == 1
