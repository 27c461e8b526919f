"""Attributes of .spz as planes of bytes, planar by attribute and interleaved by Gaussian inside each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from sw_interchange.bands import COEFFICIENTS, Array
from sw_interchange.frames import flipped
from sw_interchange.quats import from_smallest_three, smallest_three
from sw_interchange.scene import GaussianScene, WriteReport, logit_of_byte, sigmoid
from sw_interchange.threads import each_of, rows_of

if TYPE_CHECKING:
    from sw_interchange.spz import SpzOptions

Bytes = npt.NDArray[np.uint8]

COLOUR_SCALE = 0.15
"""Of band 0, in place of the 0.282 of its basis function."""
XYZW = [1, 2, 3, 0]
"""Order of a quaternion's components in the file, from w,x,y,z."""
WXYZ = [3, 0, 1, 2]


def field_sizes(count: int, version: int, degree: int) -> list[int]:
    """Bytes of positions, alphas, colours, scales, rotations and SH."""
    widths = [6 if version == 1 else 9, 1, 3, 3, 3 if version < 3 else 4, 3 * COEFFICIENTS[degree]]
    return [count * width for width in widths]


def decode_fields(
    planes: Sequence[bytes | memoryview], count: int, version: int, degree: int, fractional_bits: int
) -> GaussianScene:
    """The scene of six planes (version 4: five at degree 0), in the axes of the file."""
    raw = [np.frombuffer(plane, np.uint8).reshape(count, -1) for plane in planes if len(plane)]
    positions, alphas, colours, scales, rotations = raw[:5]
    codes = np.arange(256, dtype=np.float32)
    rest = np.empty((count, COEFFICIENTS[degree], 3), np.float32)
    means, quats = np.empty((count, 3), np.float32), np.empty((count, 4), np.float32)

    def some(rows: slice) -> None:
        means[rows] = _positions(positions[rows], version, fractional_bits)
        quats[rows] = (_first_three if version < 3 else _smallest_three)(rotations[rows])
        if degree:
            part = rest[rows].reshape(-1, rest.shape[1] * 3)
            np.subtract(raw[5][rows], np.float32(128), out=part, dtype=np.float32)
            part *= np.float32(1 / 128)

    each_of(some, rows_of(count))
    return GaussianScene(
        means=means,
        log_scales=(codes / 16 - 10)[scales],
        quats=quats,
        opacity_logits=logit_of_byte(alphas[:, 0]),
        sh_dc=((codes / 255 - 0.5) / np.float32(COLOUR_SCALE))[colours],
        sh_rest=rest,
    )


def _positions(raw: Bytes, version: int, fractional_bits: int) -> Array:
    if version == 1:
        return np.ascontiguousarray(raw).view("<f2").astype(np.float32)
    wide = np.empty((len(raw), 3, 4), np.uint8)
    wide[:, :, 0] = 0
    wide[:, :, 1:] = raw.reshape(-1, 3, 3)
    # The sign comes with the upper bits; 2^-8 undoes the shift.
    return (wide.view("<i4")[:, :, 0] * np.float64(2.0 ** -(8 + fractional_bits))).astype(np.float32)


def _first_three(raw: Bytes) -> Array:
    xyz = raw.astype(np.float32) / np.float32(127.5) - 1
    w = np.sqrt(np.maximum(0, 1 - np.einsum("ij,ij->i", xyz, xyz)))
    return np.concatenate([w[:, None], xyz], axis=1)


def _smallest_three(raw: Bytes) -> Array:
    words = np.ascontiguousarray(raw).view("<u4")[:, 0]
    fields = np.stack([words >> 20, words >> 10, words], axis=1)
    sizes = (fields & 511).astype(np.float32) * np.float32(1 / (511 * np.sqrt(2)))
    others = np.where(fields & 512, -sizes, sizes)
    return from_smallest_three(words >> 30, others)[:, WXYZ]


def encode_fields(scene: GaussianScene, options: SpzOptions, fractional_bits: int, report: WriteReport) -> list[bytes]:
    """Six planes of a scene in RDF; SH may be empty. What is clamped is counted."""
    n, k = scene.num_gaussians, scene.sh_rest.shape[1]
    sizes = field_sizes(n, options.version, scene.sh_degree)
    planes = [np.empty((n, size // n), np.uint8) for size in sizes]
    steps = np.full((k, 3), 1 << (8 - options.sh_bits), np.float32)
    steps[:3] = 1 << (8 - options.sh1_bits)
    steps = steps.reshape(-1)
    report.count("log_scales", (scene.log_scales < -10) | (scene.log_scales > 5.9375))
    report.count("sh_dc", np.abs(scene.sh_dc) > 0.5 / COLOUR_SCALE)

    def some(rows: slice) -> int:
        some_scene = scene.select(rows)  # turned part by part: a copy of it all would take as long as the rest
        some_scene = some_scene if options.frame == "raw" else flipped(some_scene, 1, -1, -1)
        planes[0][rows] = _position_codes(some_scene.means, fractional_bits)
        planes[1][rows, 0] = np.floor(255 * sigmoid(scene.opacity_logits[rows]) + np.float32(0.5))
        planes[2][rows] = _byte(255 * (np.float32(COLOUR_SCALE) * scene.sh_dc[rows] + np.float32(0.5)))
        planes[3][rows] = _byte(16 * (scene.log_scales[rows] + 10))
        coded = _first_three_codes if options.version == 2 else _smallest_three_codes
        planes[4][rows] = coded(some_scene.quats)
        if not k:
            return 0
        # floor((round(128 v) + 128 + step / 2) / step) * step, in place.
        part = some_scene.sh_rest.reshape(-1, 3 * k)
        beyond = int(np.count_nonzero(np.abs(part) > 1))
        codes = part * np.float32(128)
        codes += np.copysign(np.float32(0.5), codes)
        np.trunc(codes, out=codes)
        codes += 128 + steps / 2
        codes *= 1 / steps
        np.floor(codes, out=codes)
        codes *= steps
        planes[5][rows] = np.clip(codes, 0, 255, out=codes)
        return beyond

    if beyond := sum(each_of(some, rows_of(n))):
        report.clamped["sh_rest"] = beyond
    return [plane.tobytes() for plane in planes]


def _byte(values: Array) -> Array:
    """Rounded half away from zero, 0..255."""
    return np.clip(np.floor(values + np.float32(0.5)), 0, 255)


def _position_codes(means: Array, fractional_bits: int) -> Bytes:
    fixed = means.astype(np.float64) * 2.0**fractional_bits
    whole = (np.sign(fixed) * np.floor(np.abs(fixed) + 0.5)).astype("<i4")
    return whole.view(np.uint8).reshape(-1, 3, 4)[:, :, :3].reshape(-1, 9)


def _first_three_codes(quats: Array) -> Array:
    signs = np.where(quats[:, :1] < 0, np.float32(-1), np.float32(1))
    return _byte(np.float32(127.5) * quats[:, 1:] * signs + np.float32(127.5))


def _smallest_three_codes(quats: Array) -> Bytes:
    largest, others = smallest_three(quats[:, XYZW])
    sizes = np.minimum(np.floor(np.abs(others) * np.float32(511 * np.sqrt(2)) + np.float32(0.5)), 511).astype("<u4")
    fields = sizes | (others < 0).astype("<u4") << np.uint32(9)
    words = (largest.astype("<u4") << np.uint32(30)) | (fields[:, 0] << np.uint32(20)) | (
        fields[:, 1] << np.uint32(10)
    ) | fields[:, 2]  # fmt: skip
    return words.astype("<u4").view(np.uint8).reshape(-1, 4)
