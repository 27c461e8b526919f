"""Axes: a scene looks the same from everywhere after its numbers were turned, SH included."""

import itertools

import numpy as np
import pytest
from interchange_files import covariances, random_scene
from sw_interchange import GaussianScene
from sw_interchange.bands import COEFFICIENTS
from sw_interchange.frames import axes_of, band_rotation, flipped, sh_band, sh_signs, transformed

from splatwizard_core.api import SH_C0, UserInputError

DIRECTIONS = np.array([d for d in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(d)])  # 26
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)


def colours(scene: GaussianScene, directions: np.ndarray) -> np.ndarray:
    """[26,N,3] before they are clamped."""
    found = 0.5 + SH_C0 * np.broadcast_to(scene.sh_dc.astype(np.float64), (len(directions), *scene.sh_dc.shape)).copy()
    for degree in range(1, scene.sh_degree + 1):
        band = scene.sh_rest[:, COEFFICIENTS[degree - 1] : COEFFICIENTS[degree]]
        found += np.einsum("mk,nkc->mnc", sh_band(directions, degree), band)
    return found


def one_hot() -> GaussianScene:
    """72 Gaussians near +x, +y and +z, each with one SH coefficient of 1."""
    scene = random_scene(72, 4)
    means = np.repeat(np.eye(3, dtype=np.float32), 24, axis=0)
    rest = np.zeros((72, 24, 3), np.float32)
    rest[np.arange(72), np.tile(np.arange(24), 3), np.arange(72) % 3] = 1
    return GaussianScene(means, scene.log_scales, scene.quats, scene.opacity_logits, scene.sh_dc, rest)


@pytest.mark.parametrize("frame", ["RUB", "LUF", "RUF", "LDB", "RFU", "LBD", "FUR"])
def test_a_scene_looks_the_same_in_other_axes(frame):
    scene = one_hot()
    there = scene.in_frame(frame)
    turn = axes_of(frame).T @ axes_of("RDF")
    assert np.allclose(there.means, scene.means @ turn.T, atol=1e-6)
    assert np.abs(colours(there, DIRECTIONS @ turn.T) - colours(scene, DIRECTIONS)).max() < 1e-5
    assert np.allclose(covariances(there), turn @ covariances(scene) @ turn.T, atol=1e-6)
    back = there.in_frame("RDF")
    assert back.frame == "RDF"
    assert np.allclose(back.sh_rest, scene.sh_rest, atol=1e-5)


@pytest.mark.parametrize("signs", list(itertools.product((1, -1), repeat=3)))
def test_the_signs_of_a_flip_are_those_of_the_basis(signs):
    turned = DIRECTIONS * signs
    for degree in range(1, 5):
        band = sh_signs(*signs)[COEFFICIENTS[degree - 1] : COEFFICIENTS[degree]]
        assert np.allclose(sh_band(turned, degree), sh_band(DIRECTIONS, degree) * band, atol=1e-12)


@pytest.mark.parametrize("signs", [(1, -1, -1), (-1, -1, 1), (-1, 1, -1)])
def test_a_half_turn_as_flip_and_as_rotation_agree(signs):
    scene = random_scene(9, 3)
    flip, turn = flipped(scene, *signs), transformed(scene, np.diag(np.float64(signs)))
    assert np.allclose(flip.means, turn.means)
    assert np.allclose(flip.sh_rest, turn.sh_rest, atol=1e-6)
    assert np.allclose(covariances(flip), covariances(turn), atol=1e-6)


def rotation(seed: int) -> np.ndarray:
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q *= np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else -q


@pytest.mark.parametrize("mirror", [1, -1])
def test_any_rotation_scale_and_shift(mirror):
    scene, turn = random_scene(20, 3), mirror * rotation(3)
    there = transformed(scene, turn, 2.5, (1, -2, 3))
    assert np.allclose(there.means, 2.5 * scene.means @ turn.T + (1, -2, 3), atol=1e-4)
    assert np.abs(colours(there, DIRECTIONS @ turn.T) - colours(scene, DIRECTIONS)).max() < 1e-5
    wanted = 6.25 * turn @ covariances(scene) @ turn.T
    assert np.allclose(covariances(there), wanted, rtol=1e-4, atol=1e-6)


def test_rotations_of_bands_are_orthogonal_and_of_band_1_a_known_matrix():
    turn = rotation(5)
    swap = np.array([[0, -1, 0], [0, 0, 1], [-1, 0, 0]])
    assert np.allclose(band_rotation(turn, 1), swap @ turn @ swap.T, atol=1e-10)
    for degree in range(1, 5):
        matrix = band_rotation(turn, degree)
        assert np.abs(matrix @ matrix.T - np.eye(2 * degree + 1)).max() < 1e-10


@pytest.mark.parametrize("frame", ["", "R", "RDFX", "RLU", "rdf", "XYZ"])
def test_no_frame_is_refused(frame):
    with pytest.raises(UserInputError, match="no frame"):
        random_scene(2, 0).in_frame(frame)


def test_a_map_that_shears_is_refused():
    with pytest.raises(UserInputError, match="shear"):
        transformed(random_scene(2, 0), np.diag([1.0, 2, 1]))
