"""Axes of symmetric matrices are rotations, and put together again give the matrices."""

import pytest
import torch
from sw_gaussians.principal_axes import principal_axes


def check(count: int, device: str) -> None:
    found = torch.randn(count, 3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64).to(device)
    matrices = found @ found.mT
    values, axes = principal_axes(matrices)
    assert axes.device == matrices.device
    assert torch.allclose(axes * values[:, None] @ axes.mT, matrices, atol=1e-9)
    assert torch.allclose(torch.linalg.det(axes), torch.ones(count, dtype=torch.float64, device=device))
    assert bool((values.diff(dim=1) >= 0).all())


def test_axes_are_rotations_that_give_the_matrices():
    check(200, "cpu")


@pytest.mark.cuda
def test_so_many_matrices_that_the_solver_of_the_gpu_fails():
    check(1 << 18, "cuda")
