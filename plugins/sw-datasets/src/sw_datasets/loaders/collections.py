"""The six published collections: how their scenes are recognised on disk, and read by their own rules."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from splatwizard_core.api import Scene, SceneError, SceneOptions
from sw_datasets.families import BENCHMARKS, Family
from sw_datasets.loaders.blender import has_blender_layout, load_blender
from sw_datasets.loaders.colmap import load_colmap, model_folder
from sw_datasets.loaders.dtu import has_dtu_layout, load_dtu
from sw_datasets.loaders.enu import has_enu_layout, load_enu
from sw_datasets.rules import Rules, rules_for

AT_HOME, BY_SIGNS, BY_OWN_FILE = 0.9, 0.8, 0.9


@dataclass(frozen=True)
class Layout:
    """One way in which a family's scenes lie on disk.

    is_there    whether a folder has this layout
    load        reads such a folder
    looks_for   the file by which it is known, for messages
    own         no other family of this package has this layout
    """

    is_there: Callable[[Path], bool]
    load: Callable[[Path, Rules, SceneOptions], Scene]
    looks_for: str
    own: bool = False


COLMAP_LAYOUT = Layout(
    lambda path: model_folder(path) is not None, load_colmap, "sparse/0/cameras.bin or .txt (run COLMAP)"
)
BLENDER_LAYOUT = Layout(has_blender_layout, load_blender, "transforms_train.json")
ENU_LAYOUT = Layout(has_enu_layout, load_enu, "poses_enu.json", own=True)
DTU_LAYOUT = Layout(has_dtu_layout, load_dtu, "sparse/0/cameras.bin beside cameras.npz", own=True)


class Collection:
    """A published collection.

    layouts     tried in this order; the first that is there is read
    """

    def __init__(self, family: Family, layouts: Sequence[Layout]) -> None:
        self.family, self.layouts = family, tuple(layouts)

    def detect(self, path: Path) -> float:
        """Score how surely a folder is a scene of the collection.

        0.9     a layout that only this family has, with its prefix where it has one ("scan"); or a published scene's
                name in a folder with the collection's name
        0.8     a published scene's name, and beside the pictures what the collection's archives hold besides
        0       otherwise: a name alone is no proof
        """
        there = [layout for layout in self.layouts if layout.is_there(path)]
        if not there:
            return 0.0
        # As it is called, and where a link leads.
        places = [Path(os.path.abspath(path)), Path(os.path.realpath(path))]
        if any(layout.own for layout in there) and any(p.name.startswith(self.family.prefix) for p in places):
            return BY_OWN_FILE
        named = [place for place in places if self.family.scene_of(place.name) is not None]
        if any(self.family.is_home(place.parent.name) for place in named):
            return AT_HOME
        if named and self.family.signs and all(os.path.exists(path / sign) for sign in self.family.signs):
            return BY_SIGNS
        return 0.0

    def load(self, path: Path, options: SceneOptions) -> Scene:
        """Read by the rules of the collection. Raises SceneError in one line."""
        layout = self._layout(path)
        if layout is None:
            wanted = " nor ".join(layout.looks_for for layout in self.layouts)
            nothing = "neither " if len(self.layouts) > 1 else "no "
            raise SceneError(f"{path}: {nothing}{wanted}: not a scene of {self.family.title}", path=str(path))
        folder = path.resolve().name if self.family.scene_of(path.name) is None else path.name
        rules = rules_for(self.family, folder, options)
        scene = layout.load(path, rules, options)
        scene.name = folder  # a link goes by its own name where that is the published one
        if rules.scene is None:
            near = self.family.nearest(folder)
            hint = f" (did you mean '{near}'?)" if near else f": {', '.join(self.family.scenes)}"
            scene.warnings.append(f"'{folder}' is not a published scene of {self.family.title}{hint}")
        return scene

    def _layout(self, path: Path) -> Layout | None:
        return next((layout for layout in self.layouts if layout.is_there(path)), None)


MIPNERF360 = Collection(BENCHMARKS["mipnerf360"], [COLMAP_LAYOUT])
TANDT = Collection(BENCHMARKS["tandt"], [COLMAP_LAYOUT])
DB = Collection(BENCHMARKS["db"], [COLMAP_LAYOUT])
BUNGEE = Collection(
    BENCHMARKS["bungee"], [COLMAP_LAYOUT, ENU_LAYOUT]
)  # the archive with SfM points is what published tables use
NERF_SYNTHETIC = Collection(BENCHMARKS["nerf_synthetic"], [BLENDER_LAYOUT])
DTU = Collection(BENCHMARKS["dtu"], [DTU_LAYOUT])
