"""The files of a mesh in its folder. mesh.json comes last and goes first: where it stands, the others are whole."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from splatwizard_core.api import Scene, replacing
from sw_geometry.build import Built
from sw_geometry.mesh import Mesh
from sw_geometry.picture import save_pictures
from sw_geometry.ply import write_mesh

RAW, POST, CULLED, PICTURE, FACTS = "mesh.ply", "mesh_post.ply", "mesh_culled.ply", "mesh.png", "mesh.json"


def write_files(
    folder: Path, built: Built, scene: Scene, facts: Mapping[str, Any], culled: Mesh | None = None, *,
    world: bool = False,
) -> list[str]:  # fmt: skip
    """Write meshes, a picture and facts of a mesh; returns the names of the files.

    culled  what culling by masks left, in millimetres; None: there is none
    world   mesh.ply and mesh_post.ply have coordinates of the world, not about the scene's local origin
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name in (FACTS, CULLED):
        (folder / name).unlink(missing_ok=True)
    origin = scene.origin if world else None
    write_mesh(built.raw, folder / RAW, origin)
    write_mesh(built.post, folder / POST, origin)
    if culled is not None:
        write_mesh(culled, folder / CULLED)
    save_pictures(built.post, [view.camera for view in scene.train], folder / PICTURE)
    with replacing(folder / FACTS) as temporary:
        temporary.write_text(json.dumps(dict(facts), indent=2, allow_nan=False) + "\n", encoding="utf-8")
    return [name for name in (RAW, POST, CULLED, PICTURE, FACTS) if (folder / name).exists()]
