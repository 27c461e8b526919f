"""Axes of a scene: flips between the conventions of programs, and any rotation, scale and shift, SH included.

Source: the real SH basis and signs of 3D Gaussian Splatting (arXiv 2308.04079).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from splatwizard_core.api import UserInputError
from sw_interchange.bands import COEFFICIENTS, Array
from sw_interchange.threads import each_of, rows_of

if TYPE_CHECKING:
    from sw_interchange.scene import GaussianScene

Matrix = npt.NDArray[np.float64]

_AXES = {"R": (0, 1), "L": (0, -1), "U": (1, 1), "D": (1, -1), "B": (2, 1), "F": (2, -1)}
"""Letter -> axis and sign, in a frame that is itself RUB."""


def axes_of(frame: str) -> Matrix:
    """[3,3] whose columns are the directions of +X, +Y, +Z of `frame` in RUB. Raises UserInputError."""
    columns = np.zeros((3, 3))
    for i, letter in enumerate(frame):
        if i > 2 or letter not in _AXES:
            break
        axis, sign = _AXES[letter]
        columns[axis, i] = sign
    if len(frame) != 3 or abs(np.linalg.det(columns)) != 1:
        raise UserInputError(f"no frame '{frame}': three letters such as RDF (R or L, U or D, F or B, in any order)")
    return columns


def in_frame(scene: GaussianScene, frame: str, *, in_place: bool = False) -> GaussianScene:
    """The same scene, its numbers in the axes of `frame`. Raises UserInputError for no frame.

    in_place    the arrays of `scene` may be changed, which saves copies
    """
    if frame == scene.frame:
        return scene
    matrix = axes_of(frame).T @ axes_of(scene.frame)
    if np.count_nonzero(matrix - np.diag(np.diag(matrix))) == 0:
        flip = flipped_in_place if in_place else flipped
        return replace(flip(scene, *(int(sign) for sign in np.diag(matrix))), frame=frame)
    return replace(transformed(scene, matrix), frame=frame)


def sh_signs(sx: int, sy: int, sz: int) -> Array:
    """[24] sign of each SH coefficient of bands 1..4 under a flip of axes."""
    xy, yz, xz = sx * sy, sy * sz, sx * sz
    bands = [sy, sz, sx, xy, yz, 1, xz, 1, sy, xy * sz, sy, sz, sx, sz, sx, xy, yz, xy, yz, 1, xz, 1, xz, 1]
    return np.array(bands, np.float32)


def flipped(scene: GaussianScene, sx: int, sy: int, sz: int) -> GaussianScene:
    """Turn axes around (each +1 or -1). A mirror flip is right too: it makes the mirrored scene."""
    return replace(
        scene,
        means=scene.means * np.array([sx, sy, sz], np.float32),
        quats=scene.quats * np.array([1, sy * sz, sx * sz, sx * sy], np.float32),
        sh_rest=scene.sh_rest * sh_signs(sx, sy, sz)[: scene.sh_rest.shape[1], None],
    )


def flipped_in_place(scene: GaussianScene, sx: int, sy: int, sz: int) -> GaussianScene:
    """Do as `flipped`, in the arrays of the scene."""
    turned = np.flatnonzero(sh_signs(sx, sy, sz)[: scene.sh_rest.shape[1]] < 0)

    def some(rows: slice) -> None:
        scene.means[rows] *= np.array([sx, sy, sz], np.float32)
        scene.quats[rows] *= np.array([1, sy * sz, sx * sz, sx * sy], np.float32)
        for k in turned:
            part = scene.sh_rest[rows, k]
            np.negative(part, out=part)

    each_of(some, rows_of(scene.num_gaussians))
    return scene


def transformed(
    scene: GaussianScene, rotation: Matrix, scale: float = 1.0, shift: npt.ArrayLike = (0, 0, 0)
) -> GaussianScene:
    """Map every point x to scale * rotation x + shift; the frame's name stays.

    rotation    [3,3] orthogonal; a mirror is a flip of x and then a rotation
    scale       > 0

    Raises UserInputError if it is no such map.
    """
    rotation, offset = np.asarray(rotation, np.float64), np.asarray(shift, np.float64)
    whole = np.isfinite(rotation).all() and np.isfinite(offset).all() and np.isfinite(scale)
    if not whole or scale <= 0 or np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-4:
        raise UserInputError("this map is no rotation with one scale and a shift: it would shear Gaussians")
    if np.linalg.det(rotation) < 0:
        return transformed(flipped(scene, -1, 1, 1), rotation @ np.diag([-1.0, 1, 1]), scale, shift)
    rest = scene.sh_rest.copy()
    for degree in range(1, scene.sh_degree + 1):
        band = slice(COEFFICIENTS[degree - 1], COEFFICIENTS[degree])
        matrix = band_rotation(rotation, degree).astype(np.float32)
        rest[:, band] = np.einsum("lk,nkc->nlc", matrix, rest[:, band])
    return replace(
        scene,
        means=(scale * (scene.means.astype(np.float64) @ rotation.T) + offset).astype(np.float32),
        log_scales=(scene.log_scales + np.log(scale)).astype(np.float32),
        quats=_product(_quat_of(rotation), scene.quats.astype(np.float64)).astype(np.float32),
        sh_rest=rest,
    )


def placed(scene: GaussianScene, place: Matrix) -> GaussianScene:
    """Map every point by a matrix [4,4]. Raises UserInputError if that mirrors or shears, as `transformed` does."""
    if np.array_equal(place, np.eye(4)):
        return scene
    volume = np.linalg.det(place[:3, :3])
    if volume < 0:
        raise UserInputError("its scale is negative: it mirrors them")
    scale = math.pow(volume, 1 / 3) or 1.0
    return transformed(scene, place[:3, :3] / scale, scale, place[:3, 3])


def band_rotation(rotation: Matrix, degree: int) -> Matrix:
    """[2l+1, 2l+1] map of the coefficients of band l when the scene is rotated: orthogonal."""
    points = np.random.default_rng(degree).normal(size=(6 * (2 * degree + 1), 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    return np.linalg.pinv(sh_band(points, degree)) @ sh_band(points @ rotation, degree)


def sh_band(directions: Matrix, degree: int) -> Matrix:
    """[M, 2l+1] basis functions of band l (1..4) along unit directions [M,3]."""
    x, y, z = directions.T
    xx, yy, zz = x * x, y * y, z * z
    if degree == 1:
        parts = [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    elif degree == 2:
        parts = [
            1.0925484305920792 * x * y, -1.0925484305920792 * y * z, 0.31539156525252005 * (2 * zz - xx - yy),
            -1.0925484305920792 * x * z, 0.5462742152960396 * (xx - yy),
        ]  # fmt: skip
    elif degree == 3:
        parts = [
            -0.5900435899266435 * y * (3 * xx - yy), 2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * zz - xx - yy), 0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
            -0.4570457994644658 * x * (4 * zz - xx - yy), 1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ]  # fmt: skip
    else:
        parts = [
            2.5033429417967046 * x * y * (xx - yy), -1.7701307697799304 * y * z * (3 * xx - yy),
            0.9461746957575601 * x * y * (7 * zz - 1), -0.6690465435572892 * y * z * (7 * zz - 3),
            0.10578554691520431 * (zz * (35 * zz - 30) + 3), -0.6690465435572892 * x * z * (7 * zz - 3),
            0.47308734787878004 * (xx - yy) * (7 * zz - 1), -1.7701307697799304 * x * z * (xx - 3 * yy),
            0.6258357354491761 * (xx * (xx - 3 * yy) - yy * (3 * xx - yy)),
        ]  # fmt: skip
    return np.stack(parts, axis=1)


def _quat_of(rotation: Matrix) -> Matrix:
    """w,x,y,z of a rotation, by its largest component (Shepperd's method)."""
    r = rotation
    squares = np.array([
        1 + r[0, 0] + r[1, 1] + r[2, 2],
        1 + r[0, 0] - r[1, 1] - r[2, 2],
        1 - r[0, 0] + r[1, 1] - r[2, 2],
        1 - r[0, 0] - r[1, 1] + r[2, 2],
    ])  # fmt: skip
    products = np.array([
        [squares[0], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]],
        [r[2, 1] - r[1, 2], squares[1], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]],
        [r[0, 2] - r[2, 0], r[0, 1] + r[1, 0], squares[2], r[1, 2] + r[2, 1]],
        [r[1, 0] - r[0, 1], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], squares[3]],
    ])  # fmt: skip
    row = products[int(squares.argmax())]
    return np.asarray(row / np.linalg.norm(row))


def _product(a: Matrix, b: Matrix) -> Matrix:
    """Hamilton product of one quaternion with many [N,4]."""
    w, x, y, z = a
    table = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return b @ table.T
