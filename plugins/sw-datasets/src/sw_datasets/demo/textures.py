"""Procedural textures: linear RGB [3,n] at local points [3,n]; + - * / and integer hashes only (see shapes.py)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

import numpy as np

from sw_datasets.demo.shapes import Vec

Colour = tuple[float, float, float]
Texture = Callable[[Vec], Vec]


@dataclass(frozen=True)
class Material:
    """Look of a surface.

    texture     local points -> linear RGB in 0..1
    specular    strength of the highlight, 0 is matte
    sharpness   the highlight's exponent is 2^sharpness
    mirror      share of the surroundings that is reflected head-on (more at grazing angles)
    """

    texture: Texture
    specular: float = 0.0
    sharpness: int = 4
    mirror: float = 0.0


FACTORS = np.array([[0x8DA6B343], [0xD8163841], [0xCB1AB31F]], dtype=np.uint32)
"""Of the hash of integer coordinates, for each axis."""


def _lattice(ix: np.ndarray, iy: np.ndarray, iz: np.ndarray, seed: int) -> Vec:
    """Hash of integer coordinates -> [0,1)."""
    x, y, z = np.stack([ix, iy, iz]).astype(np.uint32) * FACTORS
    return _scrambled(x ^ y ^ z, seed)


def _scrambled(h: np.ndarray, seed: int) -> Vec:
    """[0,1) from the sum of the hash's axes, uint32, which is overwritten."""
    h ^= np.uint32((seed * 0x9E3779B9) & 0xFFFFFFFF)
    h ^= h >> np.uint32(15)
    h *= np.uint32(0x2C1B3C6D)
    h ^= h >> np.uint32(12)
    h *= np.uint32(0x297A2D39)
    h ^= h >> np.uint32(15)
    return cast(Vec, h * 2.0**-32)


def noise(p: Vec, seed: int) -> Vec:
    """Smooth value noise [n] in [0,1), one cell per unit."""
    cell = np.floor(p)
    f = p - cell
    f = f * f * (3 - 2 * f)
    rest = 1 - f
    here = cell.astype(np.int64).astype(np.uint32) * FACTORS
    (x0, y0, z0), (x1, y1, z1) = here, here + FACTORS
    planes = []
    for z in (z0, z1):
        rows = []
        for y in (y0, y1):
            yz = y ^ z
            rows.append(_scrambled(x0 ^ yz, seed) * rest[0] + _scrambled(x1 ^ yz, seed) * f[0])
        planes.append(rows[0] * rest[1] + rows[1] * f[1])
    return cast(Vec, planes[0] * rest[2] + planes[1] * f[2])


def smooth(x: Vec, low: float, high: float) -> Vec:
    """0 below `low`, 1 above `high`, a cubic between: edges as wide as `high - low`, so that they do not alias."""
    s = np.clip((x - low) / (high - low), 0, 1)
    return s * s * (3 - 2 * s)


def mix(a: Colour | Vec, b: Colour | Vec, weight: Vec) -> Vec:
    """a where weight is 0, b where it is 1; [3,n]."""
    first = np.asarray(a, dtype=np.float64).reshape(3, -1)
    second = np.asarray(b, dtype=np.float64).reshape(3, -1)
    return first + (second - first) * weight


def wave(x: Vec) -> Vec:
    """A triangle wave of period 1: 1 at integers, 0 half way."""
    return np.abs(2 * (x - np.floor(x)) - 1)


def checker(a: Colour, b: Colour, *, size: float, edge: float, seed: int, grain: float = 0.25) -> Texture:
    """A checkerboard over local x, y with a fine grain; `size` and `edge` (softness) in world units."""

    def texture(p: Vec) -> Vec:
        u = wave(p[0] / (2 * size)) - 0.5
        v = wave(p[1] / (2 * size)) - 0.5
        soft = edge / (2 * size)
        board = smooth(u, -soft, soft) * smooth(v, -soft, soft) + smooth(-u, -soft, soft) * smooth(-v, -soft, soft)
        grained = noise(p * np.array([[9.0], [9.0], [9.0]]), seed) * 0.6 + noise(p * 23.0, seed + 1) * 0.4
        return mix(a, b, board) * (1 - grain + grain * grained)

    return texture


def marble(a: Colour, b: Colour, *, scale: float, seed: int) -> Texture:
    """Veins: a wave whose phase is disturbed by noise."""

    def texture(p: Vec) -> Vec:
        q = p * scale
        phase = q[0] + 0.6 * q[1] + 0.8 * q[2] + 2.2 * noise(q, seed) + 1.0 * noise(q * 2.3, seed + 1)
        return mix(a, b, smooth(wave(phase), 0.15, 0.85))

    return texture


def bands(colours: tuple[Colour, ...], *, width: float, edge: float, seed: int, tilt: float = 0.0) -> Texture:
    """Bands of the colours in turn along local z, slanted by `tilt`, with a slight mottle."""

    def texture(p: Vec) -> Vec:
        at = (p[2] + tilt * p[0]) / width
        index = np.floor(at)
        f = at - index
        table = np.array(colours).T  # [3,c]
        here = table[:, index.astype(np.int64) % len(colours)]
        after = table[:, (index.astype(np.int64) + 1) % len(colours)]
        return mix(here, after, smooth(f, 1 - edge / width, 1.0)) * (0.85 + 0.15 * noise(p * 14.0, seed))

    return texture


def dots(ground: Colour, ink: Colour, *, spacing: float, size: float, seed: int) -> Texture:
    """Solid balls of ink on a cubic lattice, cut by the surface: round dots of many sizes."""

    def texture(p: Vec) -> Vec:
        q = p / spacing
        q = q - np.floor(q) - 0.5
        away = np.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2])
        return mix(ink, ground, smooth(away, size - 0.06, size + 0.06)) * (0.9 + 0.1 * noise(p * 11.0, seed))

    return texture


def planks(light: Colour, dark: Colour, *, width: float, seed: int) -> Texture:
    """Wood: boards along local x, each with its own tone and grain, dark joints between."""

    def texture(p: Vec) -> Vec:
        v = p[1] / width
        board = np.floor(v).astype(np.int64)
        tone = _lattice(board, board * 0, board * 0, seed)
        q = np.stack([p[0] * 1.3 + 7 * tone, p[1] * 16.0, p[2] * 16.0])
        grain = 0.65 * noise(q, seed + 1) + 0.35 * noise(q * 2.7, seed + 2)
        joint = smooth(wave(v), 0.93, 0.99)
        wood = mix(light, dark, np.clip(0.75 * grain + 0.4 * (tone - 0.5) + 0.1, 0, 1))
        return wood * (1 - 0.7 * joint)

    return texture
