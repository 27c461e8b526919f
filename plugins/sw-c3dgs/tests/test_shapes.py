"""A covariance is a squared factor times one of trace 1, and an entry of the codebook becomes a rotation again."""

import math

import pytest
import torch
from sw_reference.projection import covariances, rotation_matrices

from sw_c3dgs.shapes import FULL, UPPER, decomposed, normalised_covariances, of_trace_one, split_scales


def random(n=200, seed=0):
    g = torch.Generator().manual_seed(seed)
    return torch.randn(n, 3, generator=g, dtype=torch.float64), torch.randn(n, 4, generator=g, dtype=torch.float64)


def test_the_factor_squared_times_the_normalised_covariance_is_the_covariance():
    log_scales, quats = random()
    log_factors, shapes = split_scales(log_scales)
    found = normalised_covariances(shapes, quats)
    assert torch.allclose(found[:, [0, 3, 5]].sum(1), torch.ones(200, dtype=torch.float64))
    expected = covariances(log_scales.exp(), quats).flatten(1)[:, UPPER]
    assert torch.allclose(found * torch.exp(2 * log_factors)[:, None], expected, rtol=1e-9, atol=1e-12)
    assert torch.allclose(shapes.norm(dim=1), torch.ones(200, dtype=torch.float64))


def test_scales_far_below_float32_do_not_underflow():
    log_factors, shapes = split_scales(torch.tensor([[-200.0, -200.0, -200.0], [90.0, 0.0, 0.0]]))
    assert log_factors.tolist() == pytest.approx([-200 + math.log(3) / 2, 90.0])
    assert shapes[0].tolist() == pytest.approx([3**-0.5] * 3)


@pytest.mark.parametrize("log_scales", [[0.0, 0.0, 0.0], [0.0, 0.0, -3.0], [1.0, -2.0, -2.0], [2.0, 0.5, -4.0]])
def test_a_decomposed_covariance_is_the_same_one_also_with_repeated_eigenvalues(log_scales):
    _, quats = random(50)
    _, shapes = split_scales(torch.tensor([log_scales], dtype=torch.float64).repeat(50, 1))
    before = normalised_covariances(shapes, quats)
    found, rotations = decomposed(before)
    assert torch.allclose(normalised_covariances(found, rotations), before, atol=1e-5)
    assert torch.allclose(torch.linalg.det(rotation_matrices(rotations)), torch.ones(50, dtype=torch.float64))
    assert torch.allclose(rotations.norm(dim=1), torch.ones(50, dtype=torch.float64))
    assert float(rotations[:, 0].min()) >= 0


def test_half_turns_have_quaternions_too():
    """w is 0 there: another component has to be taken first."""
    half_turns = torch.tensor([[0.0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1], [0, 0.6, 0.8, 0]], dtype=torch.float64)
    shapes = torch.nn.functional.normalize(torch.tensor([[3.0, 2.0, 1.0]], dtype=torch.float64), dim=1).repeat(4, 1)
    before = normalised_covariances(shapes, half_turns)
    assert torch.allclose(normalised_covariances(*decomposed(before)), before, atol=1e-7)


def test_an_entry_that_is_no_covariance_becomes_a_flat_shape():
    shapes, quats = decomposed(torch.tensor([[1.0, 0.0, 0.0, -0.5, 0.0, 0.5], [0.0] * 6]))
    assert bool(torch.isfinite(shapes).all())
    assert float(shapes[0].min()) < 1e-5
    assert bool((shapes >= 0).all())
    assert torch.allclose(quats.norm(dim=1), torch.ones(2))
    assert [len(each) for each in decomposed(torch.zeros(0, 6))] == [0, 0]


def test_traces_become_1_and_entries_without_a_positive_one_stay():
    found = of_trace_one(torch.tensor([[2.0, 1, 0, 1, 0, 1], [-1.0, 0, 0, 0.5, 0, 0.25], [0.0] * 6]))
    assert found[0].tolist() == [0.5, 0.25, 0, 0.25, 0, 0.25]
    assert found[1].tolist() == [-1.0, 0, 0, 0.5, 0, 0.25]
    assert found[2].tolist() == [0.0] * 6
    assert len(FULL) == 9
