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
    folder: Path, built: Built, scene: Scene, facts: Mapping[str, Any], culled: Mesh | None = None
) -> list[str]:
    """Write meshes, a picture and facts of a mesh; returns the names of the files.

    culled  what culling by masks left, in millimetres; None: there is none
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name in (FACTS, CULLED):
        (folder / name).unlink(missing_ok=True)
    write_mesh(built.raw, folder / RAW)
    write_mesh(built.post, folder / POST)
    if culled is not None:
        write_mesh(culled, folder / CULLED)
    save_pictures(built.post, [view.camera for view in scene.train], folder / PICTURE)
    with replacing(folder / FACTS) as temporary:
        temporary.write_text(json.dumps(dict(facts), indent=2, allow_nan=False) + "\n", encoding="utf-8")
    return [name for name in (RAW, POST, CULLED, PICTURE, FACTS) if (folder / name).exists()]
