"""Log covariances: round trips, the gradient of the covariance, clamps."""

import math

import pytest
import torch

from sw_wisp import shape as s

LOW, HIGH = -9.0, 3.0


def _random(n: int = 64, spread: float = 1.0) -> tuple[torch.Tensor, torch.Tensor]:
    draws = torch.Generator().manual_seed(1)
    log_scales = torch.randn(n, 3, generator=draws, dtype=torch.float64) * spread - 2
    return log_scales, torch.randn(n, 4, generator=draws, dtype=torch.float64)


def _full(log_scales: torch.Tensor, quats: torch.Tensor) -> torch.Tensor:
    return s.matrix_of(s.six_of(*s.log_covariance(log_scales, quats)))


@pytest.mark.parametrize("spread", [0.0, 1.0, 4.6])  # 4.6: ratios of 1e4 and more
def test_scales_and_rotation_come_back(spread: float) -> None:
    log_scales, quats = _random(spread=spread)
    found = s.scales_and_quats(*s.log_covariance(log_scales, quats))
    assert torch.allclose(found[0], log_scales.sort(dim=1).values, atol=1e-9)
    assert torch.allclose(_full(*found), _full(log_scales, quats), atol=1e-8)
    assert torch.allclose(found[1].norm(dim=1), torch.ones(64, dtype=torch.float64))


def test_shape_has_the_norm_of_the_deviator() -> None:
    d, m = s.log_covariance(*_random())
    deviator = s.matrix_of(s.six_of(d, m)) - m[:, None, None] * torch.eye(3, dtype=torch.float64)
    assert torch.allclose(d.norm(dim=1), deviator.flatten(1).norm(dim=1))
    assert deviator.diagonal(dim1=1, dim2=2).sum(1).abs().max() < 1e-12


def test_rotating_a_cloud_keeps_the_norm_of_the_shapes() -> None:
    log_scales, _ = _random()
    norms = [s.log_covariance(log_scales, torch.randn(64, 4, dtype=torch.float64))[0].norm(dim=1) for _ in range(2)]
    assert torch.allclose(*norms)


def test_jacobi_is_exact_in_float32() -> None:
    six = s.six_of(*s.log_covariance(*_random(2_000, 3.0))).float()
    values, vectors = s.jacobi(six)
    expected = torch.linalg.eigvalsh(s.matrix_of(six.double()))
    assert torch.allclose(values.sort(dim=1).values.double(), expected, atol=3e-6)
    assert torch.allclose(vectors @ vectors.transpose(1, 2), torch.eye(3).expand(2_000, 3, 3), atol=2e-6)


def _cases() -> dict[str, torch.Tensor]:
    rows = {
        "random": [0.3, -0.7, 1.1], "two equal": [0.5, 0.5, -1.0], "three equal": [0.4, 0.4, 0.4],
        "near": [0.2, 0.2 + 5e-5, -0.6], "apart": [0.2, 0.2 + 2e-4, -0.6],
    }  # fmt: skip
    return {name: torch.tensor([row], dtype=torch.float64) for name, row in rows.items()}


@pytest.mark.parametrize("name", list(_cases()))
def test_gradient_is_that_of_finite_differences(name: str) -> None:
    quats = torch.tensor([[0.3, -0.2, 0.8, 0.5]], dtype=torch.float64)
    d, m = s.log_covariance(_cases()[name], quats)
    weight = torch.tensor([[0.7, -0.4, 0.2, 1.3, -0.9, 0.5]], dtype=torch.float64)

    def energy(numbers: torch.Tensor) -> torch.Tensor:
        return (s.covariance(numbers[:, :5], numbers[:, 5], LOW, HIGH) * weight).sum()

    numbers = torch.cat([d, m[:, None]], 1).requires_grad_()
    energy(numbers).backward()
    for k in range(6):
        step = torch.zeros_like(numbers)
        step[:, k] = 1e-5
        with torch.no_grad():
            expected = (energy(numbers + step) - energy(numbers - step)) / 2e-5
        assert math.isclose(numbers.grad[0, k].item(), expected.item(), rel_tol=1e-6, abs_tol=1e-7)


def test_gradient_in_float32_is_close() -> None:
    d, m = s.log_covariance(*_random(256))
    weight = torch.randn(256, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    found = []
    for kind in (torch.float64, torch.float32):
        numbers = torch.cat([d, m[:, None]], 1).to(kind).requires_grad_()
        (s.covariance(numbers[:, :5], numbers[:, 5], LOW, HIGH) * weight.to(kind)).sum().backward()
        found.append(numbers.grad.double())
    assert ((found[0] - found[1]).norm(dim=1) / found[0].norm(dim=1)).max() < 1e-3


def test_what_lies_outside_is_drawn_on_the_bound_and_learns_its_way_back() -> None:
    d, m = s.log_covariance(torch.tensor([[0.0, 0.0, 5.0]]), torch.tensor([[1.0, 0, 0, 0]]))
    d.requires_grad_()
    drawn = s.covariance(d, m, LOW, HIGH)
    assert drawn[0, 5].item() == pytest.approx(math.exp(2 * HIGH), rel=1e-5)
    (back,) = torch.autograd.grad(drawn[0, 5], d, retain_graph=True)
    (out,) = torch.autograd.grad(-drawn[0, 5], d)
    assert back.abs().max() > 1
    assert out.abs().max() == 0


def test_bounded_numbers_lie_on_the_bound_and_others_stay() -> None:
    quats = torch.tensor([[0.3, -0.2, 0.8, 0.5]] * 2)
    d, m = s.log_covariance(torch.tensor([[0.0, 1.0, 5.0], [0.0, 1.0, 2.0]]), quats)
    new_d, new_m = s.bounded(d, m, LOW, HIGH)
    assert s.scales_and_quats(new_d, new_m)[0][0].tolist() == pytest.approx([0.0, 1.0, HIGH], abs=1e-5)
    assert torch.equal(new_d[1], d[1])
    assert torch.equal(new_m[1], m[1])
