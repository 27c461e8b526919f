"""The procedural `demo` scene: solids on a wooden stage, made on the spot, with exact geometry."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatwizard_core.api import Camera, PointCloud, Protocol, Scene, View, stream
from sw_datasets.assemble import assemble_scene
from sw_datasets.demo.beside import drawn_beside
from sw_datasets.demo.picture_cache import kept_or_drawn, picture_key
from sw_datasets.demo.raycast import Solid, World, depth_map, draw, eye_of, normal_map
from sw_datasets.demo.shapes import Box, Cylinder, Sphere, Torus, Vec, dot, rotation_x, rotation_z, uniform
from sw_datasets.demo.textures import Material, bands, checker, dots, marble, planks

FLOOR_RADIUS = 2.3
FOV_X = math.radians(46)


@dataclass(frozen=True)
class DemoSize:
    """Size of the demo scene.

    views           cameras on the hemisphere; every `test_every`-th by name is a test view
    width, height   pixels
    points          start points, and `surface` exact surface samples as ground truth
    samples         rays per pixel and axis
    """

    views: int = 72
    test_every: int = 6
    width: int = 256
    height: int = 192
    points: int = 5000
    surface: int = 20_000
    samples: int = 2


SIZES = {
    "demo": DemoSize(),
    "tiny": DemoSize(views=8, test_every=4, width=64, height=48, points=600, surface=2000),
}


def build_world(seed: int = 0) -> World:
    """The solids; the seed turns them, moves them a little and changes every texture."""
    generator = stream(seed, "world")
    first = int(torch.randint(1 << 20, (), generator=generator))

    def place(x: float, y: float, z: float) -> tuple[float, float, float]:
        dx, dy = 0.10 * (uniform(generator, 2) - 0.5)
        return x + float(dx), y + float(dy), z

    def turn() -> Vec:
        return rotation_z(float(2 * math.pi * uniform(generator, 1)[0]))

    floor = Cylinder((0.0, 0.0, -0.06), r=FLOOR_RADIUS, half_height=0.06)
    ring_tube, ring = 0.13, 0.40
    solids = [
        Solid(
            floor,
            Material(planks((0.62, 0.42, 0.24), (0.30, 0.17, 0.08), width=0.23, seed=first)),
            casts_shadow=False,
        ),
        Solid(
            Sphere(place(-0.05, 0.05, 0.52), turn(), r=0.52),
            Material(marble((0.85, 0.83, 0.78), (0.05, 0.22, 0.30), scale=1.5, seed=first + 10), 0.55, 6, 0.06),
        ),
        Solid(
            Box(place(1.02, -0.35, 0.34), turn(), half=(0.30, 0.30, 0.34)),
            Material(
                checker((0.85, 0.62, 0.10), (0.10, 0.07, 0.05), size=0.15, edge=0.012, seed=first + 20), 0.25, 5, 0.0
            ),
        ),
        Solid(
            Box(place(-0.55, -1.05, 0.17), turn(), half=(0.42, 0.22, 0.17)),
            Material(dots((0.75, 0.12, 0.09), (0.92, 0.88, 0.80), spacing=0.18, size=0.30, seed=first + 30), 0.2, 4),
        ),
        Solid(
            Cylinder(place(-1.15, 0.12, 0.50), turn(), r=0.24, half_height=0.50),
            Material(
                bands(
                    ((0.10, 0.30, 0.62), (0.88, 0.86, 0.80), (0.86, 0.38, 0.08)),
                    width=0.14, edge=0.012, seed=first + 40, tilt=0.35,
                ),
                0.35, 5, 0.03,
            ),
        ),
        Solid(
            Torus(place(0.45, 1.05, ring + ring_tube), turn() @ rotation_x(math.pi / 2), ring=ring, tube=ring_tube),
            Material(
                checker((0.12, 0.48, 0.22), (0.70, 0.82, 0.30), size=0.10, edge=0.012, seed=first + 50), 0.6, 5, 0.04
            ),
        ),
        Solid(
            Sphere(place(0.48, -0.98, 0.24), turn(), r=0.24),
            Material(marble((0.55, 0.10, 0.30), (0.90, 0.55, 0.60), scale=3.0, seed=first + 60), 0.8, 7, 0.10),
        ),
        Solid(
            Sphere(place(-0.62, 1.12, 0.30), turn(), r=0.30),
            Material(dots((0.80, 0.78, 0.70), (0.30, 0.12, 0.50), spacing=0.22, size=0.32, seed=first + 70), 0.1, 3),
        ),
        Solid(
            Torus(place(1.35, 0.62, 0.09), turn(), ring=0.27, tube=0.09),
            Material(bands(((0.85, 0.25, 0.15), (0.90, 0.80, 0.55)), width=0.09, edge=0.012, seed=first + 80, tilt=1.1),
                     0.5, 6, 0.05),
        ),
    ]  # fmt: skip
    return World(solids)


def orbit(count: int, width: int, height: int) -> list[Camera]:
    """Cameras on a hemisphere band, 12 to 62 degrees up, spread by the golden angle, all looking at the middle."""
    cameras = []
    golden = math.pi * (3 - math.sqrt(5))
    for i in range(count):
        low, high = math.sin(math.radians(12)), math.sin(math.radians(62))
        rise = low + (high - low) * (i + 0.5) / count  # uniform in sin(elevation): uniform by area
        azimuth = golden * i
        distance = 4.3 + 0.35 * math.sin(5.1 * i)
        level = distance * math.sqrt(1 - rise * rise)
        eye = torch.tensor([level * math.cos(azimuth), level * math.sin(azimuth), distance * rise + 0.35]).double()
        target = torch.tensor([0.12 * math.sin(2.3 * i), 0.12 * math.cos(3.1 * i), 0.30]).double()
        up = torch.tensor([0.0, 0.0, 1.0]).double()
        cameras.append(Camera.look_at(eye, target, up, width=width, height=height, fov_x=FOV_X).to(dtype=torch.float32))
    return cameras


class ExactMaps(Mapping[str, Tensor]):
    """View name -> an exact map of the world, computed when asked for.

    draw    depth_map ([1,H,W] float32, z in the camera frame, 0 = nothing) or normal_map ([3,H,W], world frame)
    """

    def __init__(self, world: World, views: list[View], draw: Callable[[World, Camera], Tensor]) -> None:
        self._world, self._draw = world, draw
        self._cameras = {view.name: view.camera for view in views}

    def __getitem__(self, name: str) -> Tensor:
        return self._draw(self._world, self._cameras[name])

    def __iter__(self) -> Iterator[str]:
        return iter(self._cameras)

    def __len__(self) -> int:
        return len(self._cameras)


def sample_surfaces(world: World, count: int, generator: torch.Generator) -> tuple[Vec, Vec, np.ndarray]:
    """`count` points on the visible side of the surfaces: xyz [3,n], normals [3,n] and index of the solid [n].

    Uniform by area within a solid; among solids by area^0.75, so that small ones get their share.
    Points inside or against another solid, or under the stage, are left out.
    """
    share = np.array([solid.shape.area**0.75 for solid in world.solids])
    wanted = np.floor(2.2 * count * share / share.sum()).astype(int) + 8
    points, which = [], []
    for i, solid in enumerate(world.solids):
        p = solid.shape.to_world(solid.shape.sample(int(wanted[i]), generator))
        before = p + 1e-4 * world.normals(p, np.full(p.shape[1], i))  # open air, if the surface shows
        keep = p[2] > -1e-9
        for j, other in enumerate(world.solids):
            if j != i:
                keep &= ~other.shape.contains(other.shape.to_local(before))
        points.append(p[:, keep])
        which.append(np.full(int(keep.sum()), i))
    xyz, index = np.concatenate(points, axis=1), np.concatenate(which)
    chosen = torch.randperm(xyz.shape[1], generator=generator)[:count].sort().values.numpy()
    xyz, index = xyz[:, chosen], index[chosen]
    return xyz, world.normals(xyz, index), index


def start_points(world: World, cameras: list[Camera], count: int, generator: torch.Generator) -> PointCloud:
    """Start points as structure from motion finds them: noisy, coloured, each seen by at least two of the cameras."""
    xyz, _, which = sample_surfaces(world, 2 * count, generator)
    seen = np.zeros(xyz.shape[1], dtype=int)
    rgb = np.zeros_like(xyz)
    order = torch.randperm(len(cameras), generator=generator)[:12].tolist()
    for i in order:
        camera, eye = cameras[i], eye_of(cameras[i])
        way = xyz - eye
        far = np.sqrt(dot(way, way))
        t, _ = world.trace(eye, way / far)
        in_camera = camera.R.double().numpy() @ xyz + camera.tau.double().numpy()[:, None]
        u = camera.fx * in_camera[0] / in_camera[2] + camera.cx
        v = camera.fy * in_camera[1] / in_camera[2] + camera.cy
        inside = (in_camera[2] > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        visible = inside & (t > far - 1e-4)
        new = np.flatnonzero(visible & (seen == 0))
        if len(new):
            rgb[:, new] = world.shade(xyz[:, new], which[new], -way[:, new] / far[new], world.lamp_point(0.0, 0.0))
        seen += visible
    kept = np.flatnonzero(seen >= 2)
    chosen = torch.randperm(len(kept), generator=generator)[:count].sort().values.numpy()
    kept = kept[chosen]
    # 0.5 % of the stage: a little more than a good reconstruction has, so that training has something to do.
    noise = 0.012 * torch.randn(3, len(kept), generator=generator, dtype=torch.float64).numpy()
    return PointCloud(
        torch.from_numpy((xyz[:, kept] + noise).T.astype(np.float32)),
        torch.from_numpy(np.clip(rgb[:, kept].T, 0, 1).astype(np.float32)),
    )


@functools.lru_cache(maxsize=4)
def _made(size: DemoSize, seed: int, init_seed: int) -> tuple[World, tuple[Tensor, ...]]:
    """The world; surface samples and their normals; start points and their colours. Other rate points ask again."""
    world, generator = build_world(seed), stream(init_seed, "demo-points")
    xyz, normals, _ = sample_surfaces(world, size.surface, generator)
    points = start_points(world, orbit(size.views, size.width, size.height), size.points, generator)
    assert points.rgb is not None
    surface = [torch.from_numpy(rows.T.astype(np.float32)) for rows in (xyz, normals)]
    return world, (*surface, points.xyz, points.rgb)


def _picture(world: World, seed: int, camera: Camera, samples: int, background: float) -> NDArray[np.uint8]:
    """Draw a camera's picture of `build_world(seed)`, or read it, if it was drawn before."""
    key = picture_key(stream(seed, "world").get_state().numpy().tobytes(), camera, samples, background)
    shape = (camera.height, camera.width, 3)
    drawing = partial(draw, world, camera, samples=samples, background=background)
    return kept_or_drawn(key, shape, partial(drawn_beside, drawing, camera.width * camera.height * samples**2))


def make_scene(
    size: DemoSize | None = None,
    *,
    name: str = "demo",
    seed: int = 0,
    init_seed: int = 0,
    background: str = "black",
    split: str | None = None,
    source_size: tuple[int, int] | None = None,
    resolution: int = -1,
    points: str = "",
) -> Scene:
    """The demo scene, of the size asked for. Pictures are drawn or read on first use; equal arguments give equal bits.

    seed            layout and textures; init_seed: start points and surface samples
    background      "black" or "white", behind the stage
    split           see splits.py; None: every `size.test_every`-th view by name is a test view
    resolution      as in the protocol, only recorded here; `size` is what is drawn
    points          as in the protocol: "train" draws start points that the training views see
    """
    size = size or DemoSize()
    world, made = _made(size, seed, init_seed)
    surface, normals, xyz, rgb = (rows.clone() for rows in made)
    cameras = orbit(size.views, size.width, size.height)
    grey = 1.0 if background == "white" else 0.0
    views = [
        View(camera, f"view_{i:03d}.png", partial(_picture, world, seed, camera, size.samples, grey))
        for i, camera in enumerate(cameras)
    ]
    width, height = source_size or (size.width, size.height)
    return assemble_scene(
        name,
        views,
        points=PointCloud(xyz, rgb),
        train_points=lambda train: start_points(
            world, [view.camera for view in train], size.points, stream(init_seed, "demo-points")
        ),
        protocol=Protocol(
            "demo",
            images=f"{width}x{height}",
            resolution=resolution,
            split=split or f"every{size.test_every}",
            background=background,
            points=points,
        ),
        ground_truth={
            "points": surface,
            "normals": normals,
            "distance": world.distance,
            "depth": ExactMaps(world, views, depth_map),
            "normal_maps": ExactMaps(world, views, normal_map),
        },
    )
