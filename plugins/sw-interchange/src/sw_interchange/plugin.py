"""Registers `sw export`, and importers, exporters, methods and codecs of the formats that other programs use."""

from splatwizard_core.api import Registry, hookimpl


@hookimpl
def register_commands(registry: Registry) -> None:
    registry.add("export", "sw_interchange.export_command:export", position=5,
                 summary=".ply and other interchange formats")  # fmt: skip


@hookimpl
def register_exporters(registry: Registry) -> None:
    registry.add("splat", "sw_interchange.registered:export_splat", suffix=".splat",
                 summary=".splat: 32 bytes per Gaussian, no SH")  # fmt: skip
    registry.add("spz", "sw_interchange.registered:export_spz", suffix=".spz",
                 summary=".spz of Niantic, version 3: quantised, gzip")  # fmt: skip
    registry.add("spz-v4", "sw_interchange.registered:export_spz4", suffix="",
                 summary=".spz of Niantic, version 4: the same in zstd, quicker")  # fmt: skip
    registry.add("compressed-ply", "sw_interchange.registered:export_compressed_ply", suffix=".compressed.ply",
                 summary="compressed .ply of PlayCanvas, as SuperSplat reads it")  # fmt: skip
    registry.add("sog", "sw_interchange.registered:export_sog", suffix=".sog",
                 summary=".sog of PlayCanvas: WebP images, the smallest of these")  # fmt: skip
    registry.add("sog-folder", "sw_interchange.registered:export_sog_folder", suffix=".json",
                 summary="the same as images beside their meta.json")  # fmt: skip
    registry.add("gltf", "sw_interchange.registered:export_gltf", suffix=".glb",
                 summary="binary glTF with KHR_gaussian_splatting, float32")  # fmt: skip
    registry.add("usda", "sw_interchange.registered:export_usda", suffix=".usda",
                 summary="OpenUSD as text, up to 200,000 Gaussians")  # fmt: skip
    registry.add("usdc", "sw_interchange.registered:export_usdc", suffix=".usdc",
                 summary="OpenUSD as crate, through usd-core")  # fmt: skip
    registry.add("usdz", "sw_interchange.registered:export_usdz", suffix=".usdz",
                 summary="OpenUSD as archive of a crate, through usd-core")  # fmt: skip


@hookimpl
def register_importers(registry: Registry) -> None:
    registry.add("zipped-ply", "sw_interchange.registered:import_zipped_ply", suffix=".zip",
                 summary="a .ply in a ZIP archive, as Luma gives it")  # fmt: skip
    registry.add("splat", "sw_interchange.registered:import_splat", suffix=".splat",
                 summary=".splat: 32 bytes per Gaussian, no SH")  # fmt: skip
    registry.add("spz", "sw_interchange.registered:import_spz", suffix=".spz",
                 summary=".spz of Niantic, versions 1 to 4")  # fmt: skip
    registry.add("compressed-ply", "sw_interchange.registered:import_compressed_ply", suffix=".compressed.ply",
                 summary="compressed .ply of PlayCanvas")  # fmt: skip
    registry.add("sog", "sw_interchange.registered:import_sog", suffix=".sog",
                 summary=".sog of PlayCanvas, versions 1 and 2")  # fmt: skip
    registry.add("sog-folder", "sw_interchange.registered:import_sog_folder", suffix=".json",
                 summary="the same as images beside their meta.json")  # fmt: skip
    registry.add("streamed-sog", "sw_interchange.registered:import_streamed_sog", suffix="lod-meta.json",
                 summary="the finest level of a streamed SOG of PlayCanvas")  # fmt: skip
    registry.add("lcc", "sw_interchange.registered:import_lcc", suffix=".lcc",
                 summary="the finest level of an .lcc of XGRIDS")  # fmt: skip
    registry.add("rad", "sw_interchange.registered:import_rad", suffix=".rad",
                 summary="the finest Gaussians of a .rad of Spark")  # fmt: skip
    registry.add("ksplat", "sw_interchange.registered:import_ksplat", suffix=".ksplat",
                 summary=".ksplat of GaussianSplats3D, levels 0 to 2")  # fmt: skip
    registry.add("gltf", "sw_interchange.registered:import_gltf", suffix=".glb",
                 summary="binary glTF with KHR_gaussian_splatting")  # fmt: skip
    for suffix in ("usda", "usdc", "usdz", "usd"):
        registry.add(suffix, "sw_interchange.registered:import_usd", suffix=f".{suffix}",
                     summary="splats of OpenUSD, through usd-core")  # fmt: skip
    for suffix in ("pt", "ckpt", "pth"):
        registry.add(f"checkpoint-{suffix}", "sw_interchange.registered:import_checkpoint", suffix=f".{suffix}",
                     summary="checkpoints of gsplat (.pt), nerfstudio (.ckpt) and 3DGS (.pth)")  # fmt: skip


@hookimpl
def register_methods(registry: Registry) -> None:
    registry.add("spz", "sw_interchange.methods:Spz", title="SPZ",
                 summary="a trained 3DGS scene as .spz (Niantic)", training_free=True,
                 presets=["paper", "quick"], rates=["r1", "r2", "r3"])  # fmt: skip
    registry.add("sog", "sw_interchange.methods:Sog", title="SOG",
                 summary="a trained 3DGS scene as .sog (PlayCanvas)", training_free=True,
                 presets=["paper", "quick"], rates=["r1", "r2", "r3"])  # fmt: skip
    registry.add("splat", "sw_interchange.methods:Splat", summary="a trained 3DGS scene as .splat (antimatter15)",
                 training_free=True, presets=["paper", "quick"], rates=["r1"])  # fmt: skip
    registry.add("compressed-ply", "sw_interchange.methods:CompressedPly", title="compressed PLY",
                 summary="a trained 3DGS scene as compressed .ply (PlayCanvas)", training_free=True,
                 presets=["paper", "quick"], rates=["r1"])  # fmt: skip
    registry.add("gsc-quant", "sw_interchange.methods:GscQuant", title="GSC quantiser", training_free=True,
                 summary="a trained 3DGS scene by the quantiser of the MPEG GSC exploration (2025), coded without loss",
                 presets=["paper", "quick"], rates=["r1", "r2", "r3", "r4", "r5"])  # fmt: skip
    registry.add("tmc13", "sw_interchange.tmc13:Tmc13", title="TMC13", training_free=True,
                 summary="a trained 3DGS scene through MPEG's program tmc3 for G-PCC, if SPLATWIZARD_TMC3 names it",
                 available="sw_interchange.tmc3:unavailable",
                 presets=["paper", "quick"], rates=["r1", "r2", "r3", "r4", "r5"])  # fmt: skip


@hookimpl
def register_coders(registry: Registry) -> None:
    registry.add("spz", "sw_interchange.codecs:SpzCodec", codes="gaussians",
                 summary="the bytes of a .spz: quantised, gzip or zstd")  # fmt: skip
    registry.add("sog", "sw_interchange.codecs:SogCodec", codes="gaussians",
                 summary="the bytes of a .sog: codebooks and a palette, WebP")  # fmt: skip
    registry.add("splat", "sw_interchange.codecs:SplatCodec", codes="gaussians",
                 summary="the bytes of a .splat: 32 a Gaussian, no SH")  # fmt: skip
    registry.add("compressed-ply", "sw_interchange.codecs:CompressedPlyCodec", codes="gaussians",
                 summary="the bytes of a compressed .ply: quantised in chunks of 256")  # fmt: skip
    registry.add("gsc-quant", "sw_interchange.gsc_quant:GscQuantCodec", codes="gaussians",
                 summary="the quantiser of the MPEG GSC exploration, octree and columns without loss")  # fmt: skip
