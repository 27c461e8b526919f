"""Small meshes that tests of several files need."""

import numpy as np
from sw_geometry.mesh import Mesh


def sphere(rings: int, center: tuple[float, float, float] = (0, 0, 0), r: float = 1.0) -> Mesh:
    """A closed sphere of 2 * 2 * rings * (rings - 1) triangles, counter-clockwise from outside."""
    around = 2 * rings
    theta = np.pi * np.arange(1, rings)[:, None] / rings
    phi = 2 * np.pi * np.arange(around)[None] / around
    body = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta) + 0 * phi], axis=2)
    unit = np.concatenate([body.reshape(-1, 3), [[0, 0, 1], [0, 0, -1]]])
    north, south = len(unit) - 2, len(unit) - 1
    at = np.arange((rings - 1) * around).reshape(rings - 1, around)
    right = np.roll(at, -1, axis=1)
    quads = [(at[:-1], at[1:], right[1:]), (at[:-1], right[1:], right[:-1])]
    faces = [np.stack(quad, axis=2).reshape(-1, 3) for quad in quads]
    faces.append(np.stack([np.full(around, north), at[0], right[0]], axis=1))
    faces.append(np.stack([np.full(around, south), right[-1], at[-1]], axis=1))
    return Mesh(np.asarray(center) + r * unit, np.concatenate(faces), unit, (unit + 1) / 2)
