"""The canonical form of scales and rotation describes the same Gaussian."""

import numpy as np
import pytest

from sw_codecs.models.gauge import canonical, complete, multiply


def covariances(log_scales: np.ndarray, quats: np.ndarray) -> np.ndarray:
    w, x, y, z = (quats / np.linalg.norm(quats, axis=1, keepdims=True)).T
    R = np.stack(
        [
            1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
        ], axis=1,
    ).reshape(-1, 3, 3)  # fmt: skip
    return R @ (np.exp(2 * log_scales)[:, :, None] * R.transpose(0, 2, 1))


@pytest.fixture
def gaussians() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    scales = rng.normal(size=(500, 3))
    scales[:6] = [[1, 2, 3], [1, 3, 2], [2, 1, 3], [2, 3, 1], [3, 1, 2], [3, 2, 1]]  # every permutation
    scales[6:8] = [[1, 1, 1], [2, 1, 2]]  # ties
    return scales, rng.normal(size=(500, 4)) * rng.uniform(0.1, 10, size=(500, 1))


def test_the_covariance_stays(gaussians):
    np.testing.assert_allclose(covariances(*canonical(*gaussians)), covariances(*gaussians), rtol=1e-9, atol=1e-12)


def test_scales_descend_and_w_is_the_largest_component(gaussians):
    scales, quats = canonical(*gaussians)
    assert (np.diff(scales, axis=1) <= 0).all()
    assert (quats[:, 0] >= 0.5 - 1e-12).all()
    assert (quats[:, :1] >= np.abs(quats) - 1e-12).all()
    np.testing.assert_allclose(np.linalg.norm(quats, axis=1), 1)


def test_canonical_of_canonical_is_the_same(gaussians):
    once = canonical(*gaussians)
    for a, b in zip(canonical(*once), once, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12)


def test_w_follows_from_the_rest(gaussians):
    _, quats = canonical(*gaussians)
    np.testing.assert_allclose(complete(quats[:, 1:]), quats, atol=1e-12)


def test_too_long_a_vector_still_gives_a_unit_quaternion():
    found = complete(np.array([[0.8, 0.8, 0.8], [0.0, 0.0, 0.0], [1e3, 0.0, 0.0]]))
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1)
    assert found[1].tolist() == [1, 0, 0, 0]


def test_a_quaternion_of_norm_zero_is_the_identity():
    _, quats = canonical(np.array([[3.0, 2.0, 1.0]]), np.zeros((1, 4)))
    assert quats.tolist() == [[1, 0, 0, 0]]


def test_hamilton_product_on_units():
    one, i, j, k = np.eye(4)
    assert multiply(i, j).tolist() == k.tolist()
    assert multiply(j, i).tolist() == (-k).tolist()
    assert multiply(i, i).tolist() == (-one).tolist()


def test_surfels_keep_the_line_of_their_normal(gaussians):
    scales, quats = gaussians
    flat, turned = canonical(scales[:, :2], quats)
    assert flat.shape == (500, 2)
    assert (np.diff(flat, axis=1) <= 0).all()
    assert (turned[:, 0] >= 0.5 - 1e-12).all()
    thin = np.full((500, 1), -40.0)  # a covariance whose third axis is nothing
    before = covariances(np.concatenate([scales[:, :2], thin], 1), quats)
    after = covariances(np.concatenate([flat, thin], 1), turned)
    np.testing.assert_allclose(after, before, rtol=1e-9, atol=1e-12)
