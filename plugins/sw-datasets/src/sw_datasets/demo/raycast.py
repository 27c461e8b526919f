"""Draws analytic solids: nearest hits, soft shadows, view-dependent shading, pictures and exact depth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray

from splatwizard_core.api import Camera
from sw_datasets.demo.shapes import Shape, Vec, dot, normalize
from sw_datasets.demo.textures import Material

OFFSET = 1e-5
"""What a shadow ray meets this near (world units) to its surface is the surface itself."""


@dataclass(frozen=True)
class Solid:
    """A shape and its material; the stage casts no shadow on anything above it, so its shadow need not be traced."""

    shape: Shape
    material: Material
    casts_shadow: bool = True


@dataclass(frozen=True)
class Lights:
    """One square lamp that casts soft shadows, and a smooth sky.

    position, half      centre of the lamp, and half its edge (it lies level), world units
    power, ambient      weights of lamp and sky
    """

    position: tuple[float, float, float] = (2.6, -1.9, 4.4)
    half: float = 0.28
    power: float = 0.95
    ambient: float = 0.42


def sky(d: Vec) -> Vec:
    """Linear RGB [3,n] of the surroundings in unit directions d: warm low, cool high, one broad bright panel."""
    up = np.clip(0.5 + 0.5 * d[2], 0, 1)
    panel = np.maximum(0.0, 0.45 * d[0] - 0.35 * d[1] + 0.82 * d[2])
    panel = panel * panel * panel * panel
    base = np.stack([0.55 - 0.15 * up, 0.50 + 0.02 * up, 0.45 + 0.30 * up])
    return cast(Vec, base * (0.35 + 0.65 * up) + 0.9 * panel * panel)


class World:
    """Solids under a light. All arrays float64, [3,n] or [n]."""

    def __init__(self, solids: list[Solid], lights: Lights | None = None) -> None:
        self.solids = solids
        self.lights = lights or Lights()

    def trace(self, o: Vec, d: Vec) -> tuple[Vec, NDArray[np.int64]]:
        """Distance [n] and index [n] of the nearest solid along unit d [3,n] from o [3,n] or [3,1]; inf, -1: none."""
        nearest = np.full(d.shape[1], np.inf)
        which = np.full(d.shape[1], -1)
        for i, solid in enumerate(self.solids):
            t = solid.shape.intersect(o, d)
            closer = t < nearest
            nearest[closer] = t[closer]
            which[closer] = i
        return nearest, which

    def occluded(self, lamp: Vec, d: Vec, far: Vec) -> NDArray[np.bool_]:
        """[n]: whether rays from one point [3,1] along unit directions [3,n] meet something nearer than far [n]."""
        dark = np.zeros(d.shape[1], dtype=bool)
        for solid in self.solids:
            if solid.casts_shadow:
                # From one common point the test that rejects most rays needs a single dot product.
                dark |= solid.shape.intersect(lamp, d) < far
        return dark

    def normals(self, p: Vec, which: NDArray[np.int64]) -> Vec:
        """Outward unit normals [3,n] of world points that lie on the solids `which`."""
        n = np.zeros_like(p)
        for i, solid in enumerate(self.solids):
            at = np.flatnonzero(which == i)
            if len(at):
                n[:, at] = solid.shape.rotate_out(solid.shape.normal(solid.shape.to_local(p[:, at])))
        return n

    def distance(self, points: Vec) -> Vec:
        """Signed distance [n] of world points [n,3] to the surface of all solids together, negative inside.

        Exact outside; inside of solids that meet at least as near as the surface is.
        """
        p = np.asarray(points, dtype=np.float64).T
        return cast(Vec, np.min([s.shape.distance(s.shape.to_local(p)) for s in self.solids], axis=0))

    def shade(self, p: Vec, which: NDArray[np.int64], view: Vec, lamp: Vec) -> Vec:
        """Display RGB [3,n] of surface points seen from unit directions `view` (towards the eye).

        lamp    [3,1] the point of the lamp that shines on them
        """
        # Points of one solid side by side, so that each solid gets slices: gathering for each takes longer.
        order = np.argsort(which.astype(np.int16), kind="stable")
        p, view, which = p.take(order, axis=1), view.take(order, axis=1), which[order]
        bounds = np.searchsorted(which, range(len(self.solids) + 1))
        parts = [(s, slice(a, b)) for s, a, b in zip(self.solids, bounds, bounds[1:], strict=False) if a < b]
        n, albedo = np.empty_like(p), np.empty_like(p)
        for solid, at in parts:
            local = solid.shape.to_local(p[:, at])
            n[:, at] = solid.shape.rotate_out(solid.shape.normal(local))
            albedo[:, at] = solid.material.texture(local)
        to_lamp = lamp - p
        far = np.sqrt(dot(to_lamp, to_lamp))
        to_lamp /= far
        facing = np.maximum(dot(n, to_lamp), 0)
        lit = np.flatnonzero(facing > 0)
        shadow = self.occluded(lamp, -to_lamp.take(lit, axis=1), far[lit] - OFFSET)
        facing[lit[shadow]] = 0
        # Less sky is seen near the floor, except by the floor itself: a soft contact shade.
        contact = np.where(n[2] > 0.999, 1.0, 0.65 + 0.35 * np.clip(p[2] / 0.25, 0, 1))
        open_sky = 0.325 + 0.325 * n[2] + 0.35 * np.maximum(-n[2], 0)
        light = self.lights.power * facing + self.lights.ambient * open_sky * contact
        # Light falls off towards the rim of the stage, as under a spot.
        away = (p[0] * p[0] + p[1] * p[1]) / 9.0
        colour = albedo * (light / (1 + 2 * away * away))
        for solid, at in parts:
            if solid.material.specular > 0 or solid.material.mirror > 0:
                colour[:, at] += self.gloss(solid.material, n[:, at], view[:, at], to_lamp[:, at], facing[at] > 0)
        found = np.empty_like(colour)
        found[:, order] = np.sqrt(np.clip(colour, 0, 1))  # display gamma 2: sqrt is exact everywhere
        return found

    @staticmethod
    def gloss(material: Material, n: Vec, view: Vec, to_lamp: Vec, is_lit: NDArray[np.bool_]) -> Vec:
        """The view-dependent part [3,n]: Blinn's highlight of the lamp, and the sky by Schlick's Fresnel factor."""
        shine = np.maximum(dot(n, normalize(to_lamp + view)), 0)
        for _ in range(material.sharpness):
            shine = shine * shine
        cos = dot(n, view)
        graze = np.clip(1 - cos, 0, 1)
        fresnel = material.mirror + (1 - material.mirror) * graze * graze * graze * graze * graze
        highlight = np.where(is_lit, material.specular * shine, 0)
        return highlight + (0.8 * fresnel * sky(2 * cos * n - view) if material.mirror > 0 else 0)

    def colour(self, o: Vec, d: Vec, lamp: Vec, background: float) -> Vec:
        """Display RGB [3,n] along rays; `background` grey where nothing is hit."""
        t, which = self.trace(o, d)
        rgb = np.full(d.shape, background)
        at = np.flatnonzero(which >= 0)
        seen = d.take(at, axis=1)
        start = o if o.shape[1] == 1 else o.take(at, axis=1)
        rgb[:, at] = self.shade(start + t[at] * seen, which[at], -seen, lamp)
        return rgb

    def lamp_point(self, u: float, v: float) -> Vec:
        """[3,1] point of the lamp, u and v in -1..1."""
        x, y, z = self.lights.position
        return np.array([[x + u * self.lights.half], [y + v * self.lights.half], [z]])


def eye_of(camera: Camera) -> Vec:
    """[3,1] camera centre, float64."""
    R, tau = camera.R.double().cpu().numpy(), camera.tau.double().cpu().numpy()
    return -np.stack([R[0, i] * tau[0] + R[1, i] * tau[1] + R[2, i] * tau[2] for i in range(3)])[:, None]


def camera_rays(camera: Camera, *, dx: float = 0.5, dy: float = 0.5) -> tuple[Vec, Vec]:
    """World rays of all pixels, row by row: unit directions [3,HW] and their camera-frame z [HW].

    dx, dy      where in the pixel, 0..1; (0.5, 0.5) is the centre
    """
    x = (np.arange(camera.width) + dx - camera.cx) / camera.fx
    y = (np.arange(camera.height) + dy - camera.cy) / camera.fy
    gx, gy = np.meshgrid(x, y)
    gx, gy = gx.ravel(), gy.ravel()
    scale = 1 / np.sqrt(gx * gx + gy * gy + 1)
    R = camera.R.double().cpu().numpy()
    d = np.stack([R[0, i] * gx + R[1, i] * gy + R[2, i] for i in range(3)])
    return normalize(d), scale  # normalised anew: a float32 rotation keeps lengths to 1e-7 only


def draw(world: World, camera: Camera, *, samples: int, background: float) -> NDArray[np.uint8]:
    """A picture, uint8 [H,W,3]: the mean of samples x samples rays a pixel, each towards its own part of the lamp.

    background  grey level in 0..1 where nothing is hit
    """
    eye = eye_of(camera)
    total = np.zeros((3, camera.width * camera.height))
    for j in range(samples):
        for i in range(samples):
            d, _ = camera_rays(camera, dx=(i + 0.5) / samples, dy=(j + 0.5) / samples)
            u, v = (2 * i + 1) / samples - 1, (2 * j + 1) / samples - 1
            total += world.colour(eye, d, world.lamp_point(u, v), background)
    mean = total / (samples * samples)
    return cast(
        NDArray[np.uint8], np.floor(mean * 255 + 0.5).astype(np.uint8).T.reshape(camera.height, camera.width, 3)
    )


def depth_map(world: World, camera: Camera) -> torch.Tensor:
    """float32 [1,H,W]: exact z in the camera frame at pixel centres, world units; 0 where nothing is hit."""
    d, z_of = camera_rays(camera)
    t, which = world.trace(eye_of(camera), d)
    z = np.where(which >= 0, np.where(which >= 0, t, 0) * z_of, 0).astype(np.float32)
    return torch.from_numpy(z.reshape(1, camera.height, camera.width))


def normal_map(world: World, camera: Camera) -> torch.Tensor:
    """float32 [3,H,W]: exact outward unit normals at pixel centres, world frame; 0 where nothing is hit."""
    d, _ = camera_rays(camera)
    eye = eye_of(camera)
    t, which = world.trace(eye, d)
    n = world.normals(eye + np.where(which >= 0, t, 0) * d, which)
    return torch.from_numpy(n.astype(np.float32).reshape(3, camera.height, camera.width))
