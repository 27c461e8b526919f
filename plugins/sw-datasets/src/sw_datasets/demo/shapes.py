"""Analytic solids: exact ray intersections, normals, and area-uniform surface samples.

Vectors are float64 [3,n]. Everything a ray meets is computed with + - * / and square roots alone, which IEEE 754
rounds exactly: one placement gives bit-identical pictures on every machine. (Placing solids and cameras takes
sine and cosine from the C library, whose last bit may differ between platforms.)
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray

Vec = NDArray[np.float64]
"""[3,n] vectors or [n] scalars."""

Mask = NDArray[np.bool_]

SURFACE = 1e-6
"""Nearer hits than this (world units) are the surface that a ray starts from."""


def dot(a: Vec, b: Vec) -> Vec:
    """[n] scalar products of [3,n] with [3,n] or [3,1]; the order of the sum is fixed, unlike BLAS."""
    return cast(Vec, a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def normalize(a: Vec) -> Vec:
    """Unit vectors [3,n]."""
    return a / np.sqrt(dot(a, a))


def uniform(generator: torch.Generator, *shape: int) -> Vec:
    """Float64 numbers in [0,1)."""
    return cast(Vec, torch.rand(shape, generator=generator, dtype=torch.float64).numpy())


def rotation_z(angle: float) -> Vec:
    """[3,3] local -> world, turned about the vertical axis (radians)."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def rotation_x(angle: float) -> Vec:
    """[3,3] local -> world, tipped about the local x axis (radians)."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


@dataclass(frozen=True, eq=False)
class Shape:
    """A solid in its own frame; `position` [3] and `rotation` [3,3] (local -> world) place it."""

    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation: Vec = field(default_factory=lambda: np.eye(3))

    @cached_property
    def is_upright(self) -> bool:
        """Whether the local axes are those of the world: no rotation."""
        return bool((self.rotation == np.eye(3)).all())

    @property
    def radius(self) -> float:
        """Radius of a sphere about `position` that holds the solid."""
        raise NotImplementedError

    @property
    def area(self) -> float:
        """Area of the surface."""
        raise NotImplementedError

    def hit(self, o: Vec, d: Vec) -> Vec:
        """Distance [n] along unit directions d [3,n] from o [3,n] or [3,1], local frame; inf for a miss."""
        raise NotImplementedError

    def normal(self, p: Vec) -> Vec:
        """Outward unit normals [3,n] at surface points p [3,n], local frame."""
        raise NotImplementedError

    def distance(self, p: Vec) -> Vec:
        """Signed distance [n] to the surface, exact everywhere, negative inside, local frame."""
        raise NotImplementedError

    def contains(self, p: Vec) -> Mask:
        """[n], strictly inside, local frame."""
        return self.distance(p) < 0

    def sample(self, n: int, generator: torch.Generator) -> Vec:
        """n points [3,n], uniform by area, local frame."""
        raise NotImplementedError

    def rotate_in(self, v: Vec) -> Vec:
        """World directions -> local."""
        R = self.rotation
        if self.is_upright:
            return v
        return np.stack([R[0, i] * v[0] + R[1, i] * v[1] + R[2, i] * v[2] for i in range(3)])

    def rotate_out(self, v: Vec) -> Vec:
        """Local directions -> world."""
        R = self.rotation
        return np.stack([R[i, 0] * v[0] + R[i, 1] * v[1] + R[i, 2] * v[2] for i in range(3)])

    def to_local(self, p: Vec) -> Vec:
        """World points -> local."""
        return self.rotate_in(p - np.array(self.position)[:, None])

    def to_world(self, p: Vec) -> Vec:
        """Local points -> world."""
        return cast(Vec, self.rotate_out(p) + np.array(self.position)[:, None])

    def intersect(self, o: Vec, d: Vec) -> Vec:
        """Distance [n] along world rays from o [3,n] or [3,1], d [3,n] unit; inf for a miss.

        Only rays near the solid are looked at closely.
        """
        oc = o - np.array(self.position)[:, None]
        b = dot(oc, d)
        outside = dot(oc, oc) - self.radius**2
        near = (b * b > outside) & ((b < 0) | (outside < 0))
        t = np.full(near.shape, np.inf)
        index = np.flatnonzero(near)
        if len(index):
            start = oc if oc.shape[1] == 1 else oc.take(index, axis=1)
            t[index] = self.hit(self.rotate_in(start), self.rotate_in(d.take(index, axis=1)))
        return t


@dataclass(frozen=True, eq=False)
class Sphere(Shape):
    """r: radius, world units."""

    r: float = 1.0

    @property
    def radius(self) -> float:
        return self.r

    @property
    def area(self) -> float:
        return 4 * math.pi * self.r**2

    def hit(self, o: Vec, d: Vec) -> Vec:
        b = dot(o, d)
        disc = b * b - (dot(o, o) - self.r**2)
        t = -b - np.sqrt(np.maximum(disc, 0))
        return np.where((disc > 0) & (t > SURFACE), t, np.inf)

    def normal(self, p: Vec) -> Vec:
        return normalize(p)

    def distance(self, p: Vec) -> Vec:
        return cast(Vec, np.sqrt(dot(p, p)) - self.r)

    def contains(self, p: Vec) -> Mask:
        return dot(p, p) < self.r**2

    def sample(self, n: int, generator: torch.Generator) -> Vec:
        z, phi = uniform(generator, 2, n)
        z, phi = 2 * z - 1, 2 * math.pi * phi
        ring = np.sqrt(1 - z * z)
        return self.r * np.stack([ring * np.cos(phi), ring * np.sin(phi), z])


@dataclass(frozen=True, eq=False)
class Box(Shape):
    """half: half edge lengths, world units."""

    half: tuple[float, float, float] = (0.5, 0.5, 0.5)

    @property
    def radius(self) -> float:
        return math.sqrt(sum(h * h for h in self.half)) + SURFACE

    @property
    def area(self) -> float:
        a, b, c = self.half
        return 8 * (a * b + b * c + c * a)

    def hit(self, o: Vec, d: Vec) -> Vec:
        half = np.array(self.half)[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            t1, t2 = (-half - o) / d, (half - o) / d
        # 0/0: the ray runs inside a face plane; NaN compares false below, a miss.
        near = np.minimum(t1, t2).max(axis=0)
        far = np.maximum(t1, t2).min(axis=0)
        return np.where((near < far) & (near > SURFACE), near, np.inf)

    def normal(self, p: Vec) -> Vec:
        scaled = p / np.array(self.half)[:, None]
        axis = np.abs(scaled).argmax(axis=0)
        columns = np.arange(p.shape[1])
        n = np.zeros_like(p)
        n[axis, columns] = np.sign(scaled[axis, columns])
        return n

    def distance(self, p: Vec) -> Vec:
        beyond = np.abs(p) - np.array(self.half)[:, None]
        outside = np.maximum(beyond, 0)
        return np.sqrt(dot(outside, outside)) + np.minimum(beyond.max(axis=0), 0)

    def contains(self, p: Vec) -> Mask:
        return cast(Mask, (np.abs(p) < np.array(self.half)[:, None]).all(axis=0))

    def sample(self, n: int, generator: torch.Generator) -> Vec:
        a, b, c = self.half
        weights = np.cumsum([b * c, a * c, a * b])
        which, sign = uniform(generator, 2, n)
        axis = np.searchsorted(weights / weights[-1], which, side="right").clip(max=2)
        p = (2 * uniform(generator, 3, n) - 1) * np.array(self.half)[:, None]
        p[axis, np.arange(n)] = np.where(sign < 0.5, -1, 1) * np.array(self.half)[axis]
        return cast(Vec, p)


@dataclass(frozen=True, eq=False)
class Cylinder(Shape):
    """A closed cylinder about the local z axis. r, half_height: world units."""

    r: float = 0.5
    half_height: float = 0.5

    @property
    def radius(self) -> float:
        return math.hypot(self.r, self.half_height) + SURFACE

    @property
    def area(self) -> float:
        return 2 * math.pi * self.r * (2 * self.half_height + self.r)

    def hit(self, o: Vec, d: Vec) -> Vec:
        h = self.half_height
        with np.errstate(divide="ignore", invalid="ignore"):
            a = d[0] * d[0] + d[1] * d[1]
            b = o[0] * d[0] + o[1] * d[1]
            disc = b * b - a * (o[0] * o[0] + o[1] * o[1] - self.r**2)
            side = (-b - np.sqrt(np.maximum(disc, 0))) / a
            on_side = (disc > 0) & (np.abs(o[2] + side * d[2]) <= h) & (side > SURFACE)
            cap = (np.where(d[2] < 0, h, -h) - o[2]) / d[2]
            x, y = o[0] + cap * d[0], o[1] + cap * d[1]
            on_cap = (x * x + y * y <= self.r**2) & (cap > SURFACE)
        return np.minimum(np.where(on_side, side, np.inf), np.where(on_cap, cap, np.inf))

    def normal(self, p: Vec) -> Vec:
        from_side = np.abs(np.sqrt(p[0] * p[0] + p[1] * p[1]) - self.r)
        is_cap = self.half_height - np.abs(p[2]) < from_side
        zero = np.zeros_like(p[0])
        return np.where(is_cap, np.stack([zero, zero, np.sign(p[2])]), np.stack([p[0] / self.r, p[1] / self.r, zero]))

    def distance(self, p: Vec) -> Vec:
        beyond = np.stack([np.sqrt(p[0] * p[0] + p[1] * p[1]) - self.r, np.abs(p[2]) - self.half_height])
        outside = np.maximum(beyond, 0)
        return cast(Vec, np.sqrt((outside * outside).sum(axis=0)) + np.minimum(beyond.max(axis=0), 0))

    def contains(self, p: Vec) -> Mask:
        return cast(Mask, (p[0] * p[0] + p[1] * p[1] < self.r**2) & (np.abs(p[2]) < self.half_height))

    def sample(self, n: int, generator: torch.Generator) -> Vec:
        which, phi, u = uniform(generator, 3, n)
        phi = 2 * math.pi * phi
        cap = self.r / (2 * (2 * self.half_height + self.r))  # share of one cap in the area
        ring = np.where(which < 2 * cap, self.r * np.sqrt(u), self.r)
        z = np.where(which < cap, self.half_height, np.where(which < 2 * cap, -self.half_height, 0.0))
        z = np.where(which < 2 * cap, z, (2 * u - 1) * self.half_height)
        return np.stack([ring * np.cos(phi), ring * np.sin(phi), z])


@dataclass(frozen=True, eq=False)
class Torus(Shape):
    """A ring about the local z axis. ring, tube: radius of the centre circle and of the tube, world units."""

    ring: float = 0.5
    tube: float = 0.15

    @property
    def radius(self) -> float:
        return self.ring + self.tube

    @property
    def area(self) -> float:
        return 4 * math.pi**2 * self.ring * self.tube

    def distance(self, p: Vec) -> Vec:
        q = np.sqrt(p[0] * p[0] + p[1] * p[1]) - self.ring
        return cast(Vec, np.sqrt(q * q + p[2] * p[2]) - self.tube)

    def hit(self, o: Vec, d: Vec) -> Vec:
        """Sphere tracing: a step of the exact distance never passes the surface; close to it, Newton's steps.

        What 64 steps leave undecided grazes the tube, and counts as a miss.
        """
        b = dot(o, d)
        bound = np.sqrt(np.maximum(b * b - (dot(o, o) - self.radius**2), 0))
        with np.errstate(divide="ignore", invalid="ignore"):  # the slab that holds the tube, nudged outwards
            slab = (np.stack([-1.001 * self.tube - o[2], 1.001 * self.tube - o[2]])) / d[2]
        t = np.fmax(np.fmax(-b - bound, slab.min(axis=0)), 10 * SURFACE)
        end = np.fmin(-b + bound, slab.max(axis=0))
        found = np.full(t.shape, np.inf)
        alive = np.flatnonzero(t < end)
        for _ in range(64):
            way = d.take(alive, axis=1)
            p = (o if o.shape[1] == 1 else o.take(alive, axis=1)) + t[alive] * way
            rho = np.sqrt(p[0] * p[0] + p[1] * p[1])
            q = rho - self.ring
            from_circle = np.sqrt(q * q + p[2] * p[2])
            away = from_circle - self.tube
            approach = -((p[0] * way[0] + p[1] * way[1]) * (q / rho) + p[2] * way[2]) / from_circle
            # Along a ray the distance is convex where the tube is, so Newton stays in front of the first hit.
            t[alive] += np.where(away < 0.2 * self.tube, away / np.clip(approach, 0.15, 1), away)
            done = np.abs(away) < 1e-11
            found[alive[done]] = t[alive[done]]
            alive = alive[~done & (t[alive] < end[alive])]
            if not len(alive):
                break
        return np.where(found > 20 * SURFACE, found, np.inf)

    def normal(self, p: Vec) -> Vec:
        rho = np.sqrt(p[0] * p[0] + p[1] * p[1])
        shrink = 1 - self.ring / rho
        return normalize(np.stack([p[0] * shrink, p[1] * shrink, p[2]]))

    def sample(self, n: int, generator: torch.Generator) -> Vec:
        kept = np.empty((2, 0))
        while kept.shape[1] < n:  # rejection: area grows with the distance from the axis
            theta, phi, u = uniform(generator, 3, 2 * n)
            theta, phi = 2 * math.pi * theta, 2 * math.pi * phi
            accept = u * (self.ring + self.tube) < self.ring + self.tube * np.cos(theta)
            kept = np.concatenate([kept, np.stack([theta, phi])[:, accept]], axis=1)
        theta, phi = kept[:, :n]
        rho = self.ring + self.tube * np.cos(theta)
        return np.stack([rho * np.cos(phi), rho * np.sin(phi), self.tube * np.sin(theta)])
