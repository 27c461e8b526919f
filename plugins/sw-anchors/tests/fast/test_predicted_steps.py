"""Quantiser steps that a network predicts: the kernel of the CPU against torch operations in float64."""

import pytest
import torch
from sw_anchors.fast.predicted_steps import predicted_steps


def found_by(leaves, base, bounds, slopes):
    steps, hidden = predicted_steps(leaves[0], tuple(leaves[1:]), base, **bounds)
    total = (torch.cat([steps, hidden], dim=1) * slopes.to(steps)).sum()
    return [steps, hidden, *torch.autograd.grad(total, leaves)]


@pytest.mark.parametrize("count", [0, 7, 500])
@pytest.mark.parametrize("bounds", [{"offset": 1.0, "smallest": 0.4}, {"offset": 1.1}])
def test_the_kernel_equals_the_operators(count, bounds):
    """float64 has no kernel."""
    g = torch.Generator().manual_seed(0)
    sizes = ((count, 20), (18, 20), (18,), (3, 18), (3,))
    tensors = [torch.randn(size, generator=g) / (4 if len(size) == 2 else 1) for size in sizes]
    base, slopes = torch.tensor([1.0, 0.004, 0.2]), torch.randn(count, 21, generator=g)
    results = [
        found_by([t.to(dtype).requires_grad_() for t in tensors], base.to(dtype), bounds, slopes)
        for dtype in (torch.float32, torch.float64)
    ]
    if count == 500 and "smallest" in bounds:
        at_floor = (results[0][0] == base * bounds["smallest"]).float().mean()
        assert 0.05 < at_floor < 0.95
    for a, b in zip(*results, strict=True):
        torch.testing.assert_close(a.double(), b, atol=5e-5, rtol=5e-5)  # float32 sums over 500 rows


def test_the_kernel_gives_the_same_bits_on_any_number_of_threads():
    g, before, results = torch.Generator().manual_seed(0), torch.get_num_threads(), []
    tensors = [torch.randn(size, generator=g) for size in ((2000, 30), (24, 30), (24,), (3, 24), (3,))]
    slopes = torch.randn(2000, 27, generator=g)
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            leaves = [t.clone().requires_grad_() for t in tensors]
            results.append(found_by(leaves, torch.ones(3), {"offset": 1.1}, slopes))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))
