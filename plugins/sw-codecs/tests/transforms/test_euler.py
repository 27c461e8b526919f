"""Angles: the same rotation comes back, also where roll and yaw are about one axis; gradients are finite."""

import math

import numpy as np
import pytest
import torch

from sw_codecs.transforms.euler import _cos_sin, angles_of, exact_quats_of, quats_of


def quaternions(n, dtype=torch.float64, seed=0):
    return torch.randn(n, 4, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def rotation(quats):
    w, x, y, z = (quats / quats.norm(dim=1, keepdim=True)).unbind(1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, 1).reshape(-1, 3, 3)


def about(axis, angle):
    c, s = math.cos(angle), math.sin(angle)
    i, j = [k for k in range(3) if k != axis]
    found = torch.eye(3, dtype=torch.float64)
    found[i, i] = found[j, j] = c
    found[i, j], found[j, i] = (s, -s) if axis == 1 else (-s, s)
    return found


def test_the_order_is_roll_then_pitch_then_yaw():
    roll, pitch, yaw = 0.3, -0.7, 2.1
    found = rotation(quats_of(torch.tensor([[roll, pitch, yaw]], dtype=torch.float64)))[0]
    assert torch.allclose(found, about(2, yaw) @ about(1, pitch) @ about(0, roll), atol=1e-12)


@pytest.mark.parametrize(("dtype", "atol"), [(torch.float64, 1e-12), (torch.float32, 3e-6)])
def test_every_rotation_comes_back(dtype, atol):
    quats = quaternions(5000, dtype)
    angles = angles_of(quats)
    assert float(angles[:, 1].abs().max()) <= math.pi / 2 + 1e-6
    assert torch.allclose(rotation(quats_of(angles)), rotation(quats), atol=atol)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("off", [0, 1e-9, 1e-6, 5e-5, 2e-4])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_straight_up_and_down(sign, off, dtype):
    angles = torch.tensor([[r, sign * (math.pi / 2 - off), y] for r in (0.0, 0.9, -2.5) for y in (0.0, 0.4, 3.0)])
    quats = quats_of(angles.double()).to(dtype)
    assert torch.allclose(rotation(quats_of(angles_of(quats))), rotation(quats), atol=1e-3)


def test_gradients_are_those_of_the_formulas_and_finite_where_they_have_none():
    quats = quaternions(6).requires_grad_()
    assert torch.autograd.gradcheck(angles_of, (quats,))
    assert torch.autograd.gradcheck(quats_of, (angles_of(quats).detach().requires_grad_(),))
    up = torch.tensor([[1.0, 0, 1, 0], [1, 0, -1, 0], [0.5, 0.5, 0.5, -0.5]], requires_grad=True)
    angles_of(up).sum().backward()
    assert bool(torch.isfinite(up.grad).all())


def test_sine_and_cosine_without_a_library():
    x = np.concatenate([np.random.default_rng(0).uniform(-1000, 1000, 100_000), np.arange(-20, 21) * math.pi / 4])
    cosine, sine = _cos_sin(x)
    assert np.abs(cosine - np.cos(x)).max() < 4e-16 * 4
    assert np.abs(sine - np.sin(x)).max() < 4e-16 * 4


def test_exact_quaternions_are_those_of_training():
    angles = torch.from_numpy(np.random.default_rng(0).uniform(-7, 7, (1000, 3)))
    assert np.abs(exact_quats_of(angles.numpy()) - quats_of(angles).numpy()).max() < 1e-14
