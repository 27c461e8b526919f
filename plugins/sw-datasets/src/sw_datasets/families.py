"""The facts of each dataset family in one table: scenes, folders, pictures, split, background. No torch, no files.

Source: the data sets' own pages; 3D Gaussian Splatting (arXiv 2308.04079) for `inria`; the survey of 3DGS compression
(arXiv 2407.09510) for `survey`; Scaffold-GS (arXiv 2312.00109) and HAC (arXiv 2403.14530) for the split of BungeeNeRF;
2DGS (arXiv 2403.17888) for DTU.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal

PROTOCOLS = ("survey", "inria")
"""Named ways to choose the pictures of a scene; `survey` is the default of tables."""

OUTDOOR = ("bicycle", "flowers", "garden", "stump", "treehill")
INDOOR = ("room", "counter", "kitchen", "bonsai")


@dataclass(eq=False, repr=False)  # not frozen: each method that is generated costs every `sw` command time
class Pictures:
    """The picture folder and the size at which a scene is used.

    folder      picture folder; None: the layout has none to choose
    resolution  -1 (1600 px rule), 1, 2, 4, 8, or a width in pixels
    by_scene    scenes whose folder differs
    """

    folder: str | None = "images"
    resolution: int = -1
    by_scene: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))

    def folder_of(self, scene: str) -> str | None:
        """The folder for a scene."""
        return self.by_scene.get(scene, self.folder)


@dataclass(eq=False, repr=False)  # not frozen: each method that is generated costs every `sw` command time
class Family:
    """One dataset family and the rules its scenes are read by unless the user says otherwise.

    name            registry name, and the dataset in protocol ids
    title           as papers write it
    summary         one line for lists
    scenes          published scenes, by folder name; empty: any scene
    not_in_tables   those of `scenes` that the tables of the field leave out
    folders         names that the folder above the scenes has in the wild, besides `name`
    split           "every8", "lod:30", "file", "all"
    background      "black" or "white"
    pictures        protocol name -> pictures
    views           (train, test) views of every published scene, where all have the same number
    prefix          what may stand before a scene's name in its folder's name ("scan" before DTU's "24")
    looks_for       file of a layout that only this family has, for messages
    principal_point "center" or "file"
    composites      pictures with alpha are composited on the background unless the user says otherwise
    signs           files and folders that lie in every scene of the family and seldom elsewhere
    """

    name: str
    title: str
    summary: str
    scenes: tuple[str, ...] = ()
    not_in_tables: tuple[str, ...] = ()
    folders: tuple[str, ...] = ()
    split: str = "every8"
    background: Literal["black", "white"] = "black"
    pictures: Mapping[str, Pictures] = field(
        default_factory=lambda: MappingProxyType(dict.fromkeys(PROTOCOLS, Pictures()))
    )
    views: tuple[int, int] | None = None
    prefix: str = ""
    looks_for: str = ""
    principal_point: Literal["center", "file"] = "center"
    composites: bool = True
    signs: tuple[str, ...] = ()

    @property
    def table_scenes(self) -> tuple[str, ...]:
        """The published scenes that the tables of the field report."""
        return tuple(scene for scene in self.scenes if scene not in self.not_in_tables)

    def scene_of(self, folder: str) -> str | None:
        """The published scene that a folder of this name is; None if it is none of them."""
        bare = folder.removeprefix(self.prefix) if self.prefix else folder
        return bare if bare in self.scenes else None

    def is_home(self, folder: str) -> bool:
        """Whether a folder of this name is where the family's scenes lie."""
        return folder.lower() in (self.name, *self.folders)

    def nearest(self, scene: str) -> str | None:
        """The published scene whose name is spelt most like `scene`."""
        import difflib  # here: every `sw` command loads this module

        near = difflib.get_close_matches(scene, self.scenes, n=1)
        return near[0] if near else None


def _both(pictures: Pictures) -> Mapping[str, Pictures]:
    return MappingProxyType(dict.fromkeys(PROTOCOLS, pictures))


BENCHMARKS: Mapping[str, Family] = MappingProxyType(
    {
        family.name: family
        for family in (
            Family(
                "mipnerf360",
                "Mip-NeRF 360",
                "Mip-NeRF 360: COLMAP, nine scenes, every 8th view tested",
                scenes=OUTDOOR + INDOOR,
                folders=("360_v2", "mip-nerf360", "mip-nerf-360", "mip_nerf_360", "nerf_real_360"),
                pictures=MappingProxyType(
                    {
                        "survey": Pictures(),
                        # Reduced JPEGs by the data set's authors, as the 3DGS paper's table uses them.
                        "inria": Pictures(
                            by_scene=MappingProxyType(
                                {**dict.fromkeys(OUTDOOR, "images_4"), **dict.fromkeys(INDOOR, "images_2")}
                            )
                        ),
                    }
                ),
                signs=("images_2", "images_4", "images_8"),
            ),
            Family(
                "tandt",
                "Tanks & Temples",
                "Tanks & Temples: COLMAP, train and truck, every 8th view tested",
                scenes=("train", "truck"),
                folders=("tanks_and_temples",),
            ),
            Family(
                "db",
                "Deep Blending",
                "Deep Blending: COLMAP, drjohnson and playroom, every 8th view tested",
                scenes=("drjohnson", "playroom"),
                folders=("deep_blending",),
            ),
            Family(
                "bungee",
                "BungeeNeRF",
                "BungeeNeRF: COLMAP or poses_enu.json, the first 31 views tested",
                scenes=("amsterdam", "bilbao", "hollywood", "pompidou", "quebec", "rome", "56Leonard", "Transamerica"),
                not_in_tables=("56Leonard", "Transamerica"),  # the two of the original BungeeNeRF release
                folders=("bungeenerf", "bungee_nerf", "bungee-nerf", "bungee_original"),
                looks_for="poses_enu.json (BungeeNeRF)",
                split="lod:30",  # as Scaffold-GS, HAC and CAT-3DGS run it: the first 31 views are tested
            ),
            Family(
                "nerf_synthetic",
                "NeRF Synthetic",
                "NeRF Synthetic: Blender, eight scenes, own split, white",
                scenes=("chair", "drums", "ficus", "hotdog", "lego", "materials", "mic", "ship"),
                folders=("nerf-synthetic", "nerfsynthetic"),
                split="file",
                background="white",
                pictures=_both(Pictures(folder=None)),
                views=(100, 200),
                signs=("transforms_val.json", "transforms_test.json", "train", "val", "test"),
            ),
            Family(
                "dtu",
                "DTU",
                "DTU: COLMAP with masks and cameras.npz, half size, all views",
                scenes=tuple(str(n) for n in (24, 37, 40, 55, 63, 65, 69, 83, 97, 105, 106, 110, 114, 118, 122)),
                split="all",
                pictures=_both(Pictures(resolution=2)),
                prefix="scan",
                composites=False,  # 2DGS trains with the background: alpha is a mask for fusion and culling
            ),
        )
    }
)
"""The six families that published tables use, by registry name."""

COLMAP = Family("colmap", "COLMAP", "COLMAP reconstruction, binary or text, pinhole cameras")
BLENDER = Family(
    "blender",
    "Blender",
    "transforms_train.json / transforms_test.json with RGBA pictures",
    split="file",
    background="white",
    pictures=_both(Pictures(folder=None)),
)
TRANSFORMS = Family(
    "transforms",
    "transforms.json",
    "one transforms.json with pictures and intrinsics (nerfstudio, instant-ngp, Polycam, Metashape)",
    pictures=_both(Pictures(folder=None)),
    principal_point="file",  # the programs that read these files use it
)
DEMO = Family(
    "demo",
    "the procedural scene",
    "procedural scene with exact geometry, made on the spot",
    pictures=_both(Pictures(folder=None)),
)
