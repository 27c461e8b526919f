"""Registers the readers of scenes, the six published data sets, the demo scene, and the command `sw data`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from splatwizard_core.api import Registry, hookimpl
from sw_datasets.families import BENCHMARKS, BLENDER, COLMAP, DEMO, TRANSFORMS

if TYPE_CHECKING:
    from splatwizard_core.api import Scene

LOADERS = "sw_datasets.loaders"


@hookimpl
def register_datasets(registry: Registry) -> None:
    registry.add(COLMAP.name, f"{LOADERS}.colmap:ColmapDataset",
                 looks_for="sparse/0/cameras.bin or .txt (COLMAP)",
                 without_poses="run COLMAP on them first "
                 "(colmap automatic_reconstructor --image_path ... --workspace_path {path})",
                 summary=COLMAP.summary)  # fmt: skip
    registry.add(BLENDER.name, f"{LOADERS}.blender:BlenderDataset",
                 looks_for="transforms_train.json (Blender)",
                 summary=BLENDER.summary)  # fmt: skip
    registry.add(TRANSFORMS.name, f"{LOADERS}.transforms:TransformsDataset",
                 looks_for="transforms.json (nerfstudio, instant-ngp, Polycam)",
                 summary=TRANSFORMS.summary)  # fmt: skip
    registry.add(DEMO.name, "sw_datasets.demo.dataset:DemoDataset", default=True, procedural=True,
                 summary=DEMO.summary)  # fmt: skip
    for family in BENCHMARKS.values():
        looks_for = {"looks_for": family.looks_for} if family.looks_for else {}
        registry.add(family.name, f"{LOADERS}.collections:{family.name.upper()}", summary=family.summary,
                     title=family.title, scenes=list(family.scenes), table_scenes=list(family.table_scenes),
                     folders=list(family.folders), prefix=family.prefix, **looks_for)  # fmt: skip


@hookimpl
def register_downloads(registry: Registry) -> None:
    registry.add("public", "sw_datasets.downloads.registry:public_data",
                 summary="the published data sets: addresses and sizes")  # fmt: skip


@hookimpl
def register_commands(registry: Registry) -> None:
    registry.add("data", "sw_datasets.commands.data:data", position=10,
                 summary="scenes on disk: list, verify, fetch, undistort, synth")  # fmt: skip


@hookimpl
def describe_scene(scene: Scene) -> dict[str, Any]:
    # Imported here: every `sw` command loads this module.
    from sw_datasets.describe import describe

    return describe(scene)
