"""Pictures of a mesh: shaded, from the cameras of its scene, by Open3D's ray caster, which needs no display."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatwizard_core.api import Camera, replacing
from sw_geometry.mesh import Mesh
from sw_geometry.open3d_import import import_open3d

AMBIENT = 0.35
"""Brightness of what faces away from the light, which stands at the camera."""
GREY = 0.75


def draw(mesh: Mesh, camera: Camera, *, colored: bool = False) -> NDArray[np.uint8]:
    """A picture [H,W,3] of a mesh in grey, or in the colours of its vertices; white where it is not.

    A triangle that is seen from inside is drawn darker, with a tint: such faces are a fault of a mesh.
    """
    open3d = import_open3d()
    caster = open3d.t.geometry.RaycastingScene()
    core = open3d.core
    caster.add_triangles(core.Tensor(mesh.vertices.astype(np.float32)), core.Tensor(mesh.triangles.astype(np.uint32)))
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


def save_pictures(mesh: Mesh, camera: Camera, path: Path) -> None:
    """Write a PNG of the mesh, atomically: grey beside its colours where it has some."""
    from PIL import Image

    shown = [draw(mesh, camera)] + ([draw(mesh, camera, colored=True)] if mesh.colors is not None else [])
    with replacing(path) as temporary:
        Image.fromarray(np.concatenate(shown, axis=1)).save(temporary, format="PNG")
