"""What this package provides: loaders, the six published data sets, the demo scene, and the command `sw data`."""

from splatwizard_core.api import Registry, hookimpl


@hookimpl
def register_datasets(registry: Registry) -> None:
    registry.add("colmap", "sw_datasets.colmap:ColmapDataset",
                 summary="COLMAP reconstruction, binary or text, pinhole cameras")  # fmt: skip
    registry.add("blender", "sw_datasets.blender:BlenderDataset",
                 summary="transforms_train.json / transforms_test.json with RGBA pictures")  # fmt: skip
    registry.add("demo", "sw_datasets.demo.dataset:DemoDataset",
                 default=True, procedural=True, summary="procedural scene with exact geometry, made on the spot")  # fmt: skip
    collections = "sw_datasets.collections"
    registry.add("mipnerf360", f"{collections}:MIPNERF360",
                 summary="Mip-NeRF 360: COLMAP, nine scenes, every 8th view tested")  # fmt: skip
    registry.add("tandt", f"{collections}:TANDT",
                 summary="Tanks & Temples: COLMAP, train and truck, every 8th view tested")  # fmt: skip
    registry.add("db", f"{collections}:DB",
                 summary="Deep Blending: COLMAP, drjohnson and playroom, every 8th view tested")  # fmt: skip
    registry.add("bungee", f"{collections}:BUNGEE",
                 summary="BungeeNeRF: COLMAP or poses_enu.json, the first 31 views tested")  # fmt: skip
    registry.add("nerf_synthetic", f"{collections}:NERF_SYNTHETIC",
                 summary="NeRF Synthetic: Blender, eight scenes, own split, white")  # fmt: skip
    registry.add("dtu", f"{collections}:DTU_SCANS",
                 summary="DTU: COLMAP with masks and cameras.npz, half size, all views")  # fmt: skip


@hookimpl
def register_commands(registry: Registry) -> None:
    registry.add("data", "sw_datasets.commands.data:data", position=10,
                 summary="scenes on disk: list, verify, fetch, undistort, synth")  # fmt: skip
