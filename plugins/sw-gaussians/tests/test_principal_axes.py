"""Axes of symmetric matrices are rotations, and put together again give the matrices."""

import pytest
import torch
from sw_gaussians.principal_axes import axes_by_turns, principal_axes


def check(found, matrices: torch.Tensor) -> None:
    values, axes = found
    unit = matrices.abs().amax(dim=(1, 2), keepdim=True).clamp_min(1e-300)
    assert axes.device == matrices.device
    assert bool(((axes * values[:, None] @ axes.mT - matrices).abs() <= 1e-13 * unit).all())
    assert torch.allclose(axes.mT @ axes, torch.eye(3, dtype=axes.dtype, device=axes.device).expand_as(axes))
    assert torch.allclose(torch.linalg.det(axes), torch.ones(len(axes), dtype=axes.dtype, device=axes.device))
    assert bool((values.diff(dim=1) >= 0).all())


def covariances(count: int) -> torch.Tensor:
    found = torch.randn(count, 3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return found @ found.mT


def needles(count: int) -> torch.Tensor:
    """Of axes a million times as long as others, turned in all ways."""
    turns = torch.linalg.qr(covariances(count)).Q
    return turns * torch.tensor([1e-12, 1.0, 1e-6], dtype=torch.float64) @ turns.mT


ALIKE = torch.stack([torch.zeros(3, 3), torch.eye(3), torch.ones(3, 3), torch.diag(torch.tensor([3.0, 1, 2]))]).double()


@pytest.mark.parametrize("solve", [principal_axes, axes_by_turns])
@pytest.mark.parametrize(
    "matrices", [covariances(200), needles(200), ALIKE, 1e-30 * ALIKE], ids=["usual", "needles", "alike", "small"]
)
def test_axes_are_rotations_that_give_the_matrices(solve, matrices):
    symmetric = (matrices + matrices.mT) / 2
    check(solve(symmetric), symmetric)


def test_both_solvers_find_the_same_values():
    assert torch.allclose(axes_by_turns(covariances(100))[0], principal_axes(covariances(100))[0], rtol=1e-12)


@pytest.mark.cuda
def test_many_matrices_take_little_memory_on_a_gpu():
    matrices = covariances(1 << 18).cuda()
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    check(principal_axes(matrices), matrices)
    assert torch.cuda.max_memory_allocated() - before < 2000 * len(matrices)
