"""Compiled kernels of the exact mode: the integers and the bytes of the torch and numpy operations they stand for."""

import itertools

import pytest
import torch
from torch import nn

from sw_codecs.context.hash_grid import HashGrid
from sw_codecs.context.integer_mlp import IntegerMlp


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def both(kernels, compute):
    """Results of `compute` with kernels and without."""
    found = []
    for compiled in (True, False):
        kernels(compiled)
        found.append(compute())
    return found


@pytest.mark.parametrize("sizes", [(3, 2), (24, 50, 12), (150, 100, 175), (7, 1, 13, 2), (300, 12)])
@pytest.mark.parametrize("rows", [0, 1, 61])
def test_a_network(sizes, rows, kernels):
    torch.manual_seed(0)
    layers = [part for a, b in itertools.pairwise(sizes) for part in (nn.Linear(a, b), nn.ReLU())][:-1]
    made = IntegerMlp.from_module(nn.Sequential(*layers), output_scale=1000.0)
    inputs = torch.randint(-(2**21), 2**21, (rows, sizes[0]), generator=generator())
    ours, expected = both(kernels, lambda: made(inputs))
    assert ours.shape == (rows, sizes[-1])
    assert torch.equal(ours, expected)
    kernels(True)
    out = torch.zeros(rows + 2, sizes[-1], dtype=torch.int64)
    made(inputs, out=out[1:-1])
    assert torch.equal(out[1:-1], expected)
    assert not out[0].any()
    assert not out[-1].any()


@pytest.mark.parametrize("largest", [4096, 30_000, 1 << 20])
@pytest.mark.parametrize("weight", [0.05, 5.0, 300.0, 4000.0])
def test_a_network_of_small_and_of_large_numbers(weight, largest, kernels):
    torch.manual_seed(0)
    network = nn.Sequential(nn.Linear(41, 30), nn.ReLU(), nn.Linear(30, 29))
    with torch.no_grad():
        network[2].weight[7] *= 40  # one tile of two parts, one of one
        for each in (network[0], network[2]):
            each.weight *= weight / each.weight.abs().max()
    made = IntegerMlp.from_module(network)
    inputs = torch.randint(-largest, largest + 1, (61, 41), generator=generator())
    inputs[:50] //= 1000  # blocks of rows differ in the products that hold them
    inputs[60] = largest
    ours, expected = both(kernels, lambda: made(inputs))
    assert torch.equal(ours, expected)
    assert ours.any()
    if largest < 1 << 15:
        ours, expected = both(kernels, lambda: made(inputs.to(torch.int16)))
        assert torch.equal(ours, expected)


@pytest.mark.parametrize("widths", [(0, 7), (20, 150), (3, 4)])
@pytest.mark.parametrize("leak", [0, 41])
def test_a_leaky_network_of_inputs_side_by_side(leak, widths, kernels):
    torch.manual_seed(1)
    layers = [(torch.randn(a, b).numpy(), torch.randn(a).numpy()) for a, b in ((40, sum(widths)), (30, 40))]
    made = IntegerMlp(layers, leak=leak)
    whole = torch.randint(-(2**17), 2**17, (61, 200), generator=generator())
    parts = whole[:, : widths[0]], whole[:, 10 : 10 + widths[1]]
    ours, expected = both(kernels, lambda: made(*parts))
    assert torch.equal(ours, expected)
    assert torch.equal(made(torch.cat(parts, dim=1)), expected)
    assert torch.equal(made(*parts, rows=7), expected)
    kernels(True)
    small = [part // 8 for part in parts]
    for narrow in ([0], [1], [0, 1]):
        given = [part.to(torch.int16) if i in narrow else part for i, part in enumerate(small)]
        assert torch.equal(made(*given), made(*small))


def test_a_table_that_changed_is_looked_up_anew(kernels):
    grid = HashGrid.binary_grid(3, (6, 18), features=2, log2_size=9, generator=generator())
    codes = torch.randint(0, 65_536, (50, 3), generator=generator(1))
    kernels(True)
    before = grid.integer_features(codes)
    with torch.no_grad():
        grid.table.neg_()
    ours, expected = both(kernels, lambda: grid.integer_features(codes))
    assert not torch.equal(ours, before)
    assert torch.equal(ours, expected)
