"""The contract of a dataset family, and the options that a scene is read with."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal
from typing import Protocol as TypingProtocol

from splatwizard_core.scene.scene import Scene


@dataclass(frozen=True)
class SceneOptions:
    """Options of reading a scene; None means the family's own default.

    protocol        "survey" or "inria": which named choice of pictures the family's defaults follow (None: "survey")
    images          picture folder of a COLMAP scene, such as "images_2"
    resolution      -1 (1600 px rule), 1, 2, 4, 8, or a width in pixels
    split, test_every   "every8" (test_every=8 in short) and the like, "file", "all", or a file of view names
    points          which start points are used: "all", or those that training views saw ("train-tracks")
    background, principal_point    "black" or "white"; "center" or "file"
    mask_background pictures are cut out by alpha or mask, those of Blender scenes always; False: alpha is a mask only
    legacy_8bit_composite   Blender pictures are composited in 8 bit with truncation (3DGS code); False: in float
    exif_turn       whether EXIF turns pictures whose size does not tell; None: it does not, with a warning
    init_points, seed   how many random start points where there is no SfM, and their seed
    """

    protocol: Literal["survey", "inria"] | None = None
    images: str | None = None
    resolution: int | None = None
    test_every: int | None = None
    split: str | None = None
    points: Literal["all", "train-tracks"] | None = None
    background: Literal["black", "white"] | None = None
    principal_point: Literal["center", "file"] | None = None
    mask_background: bool | None = None
    legacy_8bit_composite: bool = False
    exif_turn: bool | None = None
    init_points: int = 100_000
    seed: int = 0


class Dataset(TypingProtocol):
    """One family of scenes, found by explicit detection, never by catching errors.

    Its registry entry may declare:

    looks_for       file by which such a folder is known, for messages
    without_poses   advice for a folder of pictures without poses; {path} stands for the folder
    procedural      scenes are made on the spot: `load` gets the family's name, or VARIANT of NAME:VARIANT, as path
    default         the scene that is used where none is named (of our packages only)
    title, scenes   of a published collection: as papers write it, and its scenes by folder name
    folders         names that the folder above its scenes has in the wild, besides the family's own
    prefix          text that may stand before a scene's name in its folder's name
    """

    def detect(self, path: Path) -> float:
        """Score how surely `path` is of this family: 0 (no) to 1 (only this). Reads names, not pictures.

        Families of a layout answer 0.5, those of a published collection 0.8 to 0.9.
        """
        ...

    def load(self, path: Path, options: SceneOptions) -> Scene:
        """Read cameras, points and the list of pictures. Raises SceneError in one line."""
        ...
