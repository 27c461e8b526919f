"""Pictures of a mesh: shaded, from the cameras of its scene, by Open3D's ray caster, which needs no display."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatwizard_core.api import Camera, replacing
from sw_geometry.mesh import Mesh
from sw_geometry.open3d_import import import_open3d

AMBIENT = 0.35
"""Brightness of what faces away from the light, which stands at the camera."""
GREY = 0.75
VIEWS = 4
WIDEST = 2048  # px, of all views together


def caster_of(mesh: Mesh) -> Any:
    """Open3D's ray caster with the triangles of a mesh."""
    open3d = import_open3d()
    caster, core = open3d.t.geometry.RaycastingScene(), open3d.core
    caster.add_triangles(core.Tensor(mesh.vertices.astype(np.float32)), core.Tensor(mesh.triangles.astype(np.uint32)))
    return caster


def draw(mesh: Mesh, camera: Camera, caster: Any, *, colored: bool = False) -> NDArray[np.uint8]:
    """A picture [H,W,3] of a mesh in grey, or in the colours of its vertices; white where it is not.

    caster  `caster_of` the mesh

    A triangle that is seen from inside is drawn darker, with a tint: such faces are a fault of a mesh.
    """
    core = import_open3d().core
    rays = _rays(camera)
    found = caster.cast_rays(core.Tensor(rays))
    hit = np.isfinite(found["t_hit"].numpy())
    rows = found["primitive_ids"].numpy()[hit]
    normals = mesh.crossed()[rows]
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    way = rays[hit][:, 3:]
    facing = -(normals * way).sum(axis=1) / np.linalg.norm(way, axis=1)
    if colored and mesh.colors is not None:
        uv = found["primitive_uvs"].numpy()[hit]
        weights = np.stack([1 - uv.sum(axis=1), uv[:, 0], uv[:, 1]], axis=1)
        base = (mesh.colors[mesh.triangles[rows]] * weights[:, :, None]).sum(axis=1)
    else:
        base = np.full((len(rows), 3), GREY) * (AMBIENT + (1 - AMBIENT) * np.abs(facing))[:, None]
    base = np.where((facing < 0)[:, None], base * (0.8, 0.45, 0.45), base)
    picture = np.ones((*hit.shape, 3))
    picture[hit] = base
    return np.asarray(np.rint(np.clip(picture, 0, 1) * 255), dtype=np.uint8)


def _rays(camera: Camera) -> NDArray[np.float32]:
    """[H,W,6]: origin and direction of the ray through the centre of each pixel, world."""
    R, center = camera.R.double().cpu().numpy(), camera.center.double().cpu().numpy()
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    gx, gy = np.meshgrid(x, y)
    way = np.stack([gx, gy, np.ones_like(gx)], axis=2) @ R  # rows: R^T d
    return np.concatenate([np.broadcast_to(center, way.shape), way], axis=2).astype(np.float32)


def turntable(cameras: Sequence[Camera], count: int) -> list[Camera]:
    """At most `count` of the cameras, evenly spread as seen from above their middle."""
    centers = np.stack([camera.center.double().cpu().numpy() for camera in cameras])
    away = centers - centers.mean(axis=0)
    _, _, axes = np.linalg.svd(away, full_matrices=False)  # the two in which they spread most
    around = np.argsort(np.arctan2(away @ axes[min(1, len(axes) - 1)], away @ axes[0]), kind="stable")
    return [
        cameras[i] for i in around[np.linspace(0, len(cameras), min(count, len(cameras)), endpoint=False, dtype=int)]
    ]


def save_pictures(mesh: Mesh, cameras: Sequence[Camera], path: Path) -> None:
    """Write a PNG of the mesh from four of the cameras, atomically: in grey, and below in its colours."""
    from PIL import Image

    caster, chosen = caster_of(mesh), turntable(cameras, VIEWS)
    chosen = [each.resized(chosen[0].width, chosen[0].height) for each in chosen]
    rows = [np.concatenate([draw(mesh, camera, caster) for camera in chosen], axis=1)]
    if mesh.colors is not None:
        rows.append(np.concatenate([draw(mesh, camera, caster, colored=True) for camera in chosen], axis=1))
    with replacing(path) as temporary:
        picture = Image.fromarray(np.concatenate(rows, axis=0))
        picture.thumbnail((WIDEST, WIDEST))
        picture.save(temporary, format="PNG")
