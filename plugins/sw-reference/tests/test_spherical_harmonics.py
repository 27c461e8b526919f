"""The SH basis against scipy's complex harmonics, its orthonormality, and the colour helpers."""

import math

import pytest
import torch
from scipy import special
from sw_reference.spherical_harmonics import eval_sh, sh_basis, sh_colors

from splatwizard_core.errors import ShapeError
from splatwizard_core.gaussians.inputs import SH, rgb_to_dc


def fibonacci_sphere(n):
    i = torch.arange(n, dtype=torch.float64) + 0.5
    z = 1 - 2 * i / n
    angle = i * math.pi * (1 + math.sqrt(5))
    r = torch.sqrt(1 - z * z)
    return torch.stack([r * torch.cos(angle), r * torch.sin(angle), z], dim=1)


def random_directions(n):
    x = torch.randn(n, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return torch.nn.functional.normalize(x, dim=1)


def complex_harmonic(degree, order, polar, azimuth):
    if hasattr(special, "sph_harm_y"):
        return special.sph_harm_y(degree, order, polar, azimuth)
    return special.sph_harm(order, degree, azimuth, polar)


def test_basis_equals_the_real_harmonics_of_scipy():
    """Index l^2 + l + m: sqrt(2) times the real part of Y_l^|m| (m > 0) or the imaginary part (m < 0).

    Both keep the Condon-Shortley phase, hence B3 = -C1 x.
    """
    directions = random_directions(20)
    basis = sh_basis(directions, 3)
    polar = torch.acos(directions[:, 2]).numpy()
    azimuth = torch.atan2(directions[:, 1], directions[:, 0]).numpy()
    for degree in range(4):
        for order in range(-degree, degree + 1):
            value = complex_harmonic(degree, abs(order), polar, azimuth)
            if order == 0:
                expected = value.real
            else:
                expected = math.sqrt(2) * (value.real if order > 0 else value.imag)
            actual = basis[:, degree * degree + degree + order]
            torch.testing.assert_close(actual, torch.from_numpy(expected), atol=1e-12, rtol=1e-9)


def test_basis_is_orthonormal_on_the_sphere():
    n = 20_000
    basis = sh_basis(fibonacci_sphere(n), 3)
    gram = basis.T @ basis * (4 * math.pi / n)
    torch.testing.assert_close(gram, torch.eye(16, dtype=torch.float64), atol=1e-3, rtol=0)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_bands_above_the_active_degree_get_no_gradient(degree):
    sh = torch.randn(5, 16, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64, requires_grad=True)
    colors = eval_sh(sh, random_directions(5), degree)
    (gradient,) = torch.autograd.grad(colors.sum(), sh)
    used = (degree + 1) ** 2
    assert float(gradient[:, used:].abs().sum()) == 0
    assert float(gradient[:, :used].abs().min()) > 0
    lower = eval_sh(sh[:, :used], random_directions(5), 3)
    torch.testing.assert_close(colors, lower)


def test_gradients_of_colours_reach_sh_and_means():
    generator = torch.Generator().manual_seed(2)
    sh = torch.randn(3, 16, 3, generator=generator, dtype=torch.float64, requires_grad=True)
    means = torch.randn(3, 3, generator=generator, dtype=torch.float64, requires_grad=True)
    center = torch.tensor([3.0, -2.0, 5.0], dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda s, m: sh_colors(SH(dense=s), center, m, clamp=False), (sh, means))


def test_colours_are_clamped_below_only_and_the_gradient_passes_at_zero():
    sh = rgb_to_dc(torch.tensor([[[-0.5, 0.0, 1.7]]], dtype=torch.float64)).requires_grad_()
    means = torch.zeros(1, 3, dtype=torch.float64)
    center = torch.tensor([0.0, 0, -4], dtype=torch.float64)
    colors = sh_colors(SH(dense=sh, active_degree=0), center, means)
    assert eval_sh(sh, torch.tensor([[0.0, 0, 1]], dtype=torch.float64), 0)[0, 1] + 0.5 == 0  # exactly on the threshold
    torch.testing.assert_close(colors.detach(), torch.tensor([[0, 0, 1.7]], dtype=torch.float64))
    (gradient,) = torch.autograd.grad(colors.sum(), sh)
    assert [float(x) > 0 for x in gradient[0, 0]] == [False, True, True]
    unclamped = sh_colors(SH(dense=sh, active_degree=0), center, means, clamp=False)
    torch.testing.assert_close(unclamped.detach(), torch.tensor([[-0.5, 0, 1.7]], dtype=torch.float64))


def test_colours_that_are_the_same_from_every_side():
    rgb = torch.linspace(0, 1, 12, dtype=torch.float64).reshape(4, 3)
    means = random_directions(4)
    center = torch.tensor([0.0, 0, -4], dtype=torch.float64)
    torch.testing.assert_close(sh_colors(SH.from_rgb(rgb), center, means), rgb)
    torch.testing.assert_close(eval_sh(rgb_to_dc(rgb)[:, None], means, 0) + 0.5, rgb)


def test_colours_of_some_rows_are_those_of_all():
    sh = SH(dense=torch.randn(5, 9, 3, generator=torch.Generator().manual_seed(3)), active_degree=2)
    means, center, rows = random_directions(5).float(), torch.tensor([0.0, 0, -4]), torch.tensor([4, 1])
    assert torch.equal(sh_colors(sh, center, means, rows=rows), sh_colors(sh, center, means)[rows])


def test_wrong_shapes_are_named():
    with pytest.raises(ShapeError, match="5 SH coefficients"):
        eval_sh(torch.zeros(2, 5, 3), random_directions(2).float(), 3)
    with pytest.raises(ShapeError, match=r"\[N,K,3\]"):
        eval_sh(torch.zeros(2, 4), random_directions(2).float(), 3)
