"""The core as a plugin of itself: the loaders, metrics, exporters and the reference rasterizer that it ships."""

from splatwizard_core.plugins.hookspecs import hookimpl
from splatwizard_core.plugins.registry import Registry


@hookimpl
def register_rasterizers(registry: Registry) -> None:
    registry.add(
        "reference",
        "splatwizard_core.rendering.reference:ReferenceRasterizer",
        summary="pure-torch oracle of 3DGS and 2DGS: any device, float64, slow",
        devices=["cpu", "cuda"],
        dtypes=["float32", "float64"],
        features=[
            "BACKWARD", "ANTIALIAS", "ABSGRAD", "VISIBLE_FILTER", "COV3D", "COLORS_ND", "EXTRA_FEATURES",
            "SPLIT_SH", "INDEXED_SH", "INDEXED_GEOM", "NO_COLOR_CLAMP", "DEPTH_INVERSE", "DEPTH_ACCUM",
            "DEPTH_EXPECTED", "DEPTH_MEDIAN", "ALPHA_MAP", "SCORE_HITS", "SCORE_OPACITY", "SCORE_OPACITY_T",
            "SCORE_BLEND", "SCORE_BLEND_MAX", "SCORE_GAMMA", "SCORE_DIST", "SCORE_PIXEL_WEIGHT",
            "SCORE_GRAD_SQ", "FISHER", "FLOAT64", "SURFEL", "NORMALS", "DISTORTION",
        ],
        # Surfels have a low-pass of their own, and the scores are those of ellipsoids.
        combos_forbidden=[
            ["SURFEL", other]
            for other in (
                "ANTIALIAS", "ABSGRAD", "SCORE_HITS", "SCORE_OPACITY", "SCORE_OPACITY_T", "SCORE_BLEND",
                "SCORE_BLEND_MAX", "SCORE_GAMMA", "SCORE_DIST", "SCORE_GRAD_SQ", "FISHER",
            )
        ] + [["COV3D", "FISHER"]],
        exactness="exact",
        speed=0,
    )  # fmt: skip


@hookimpl
def register_datasets(registry: Registry) -> None:
    registry.add("colmap", "splatwizard_core.scene.loaders.colmap:ColmapDataset",
                 summary="COLMAP reconstruction, binary or text, pinhole cameras")  # fmt: skip
    registry.add("blender", "splatwizard_core.scene.loaders.blender:BlenderDataset",
                 summary="transforms_train.json / transforms_test.json with RGBA pictures")  # fmt: skip
    registry.add("demo", "splatwizard_core.scene.loaders.demo:DemoDataset",
                 summary="procedural scene with exact geometry, made on the spot")  # fmt: skip
    collections = "splatwizard_core.scene.loaders.collections"
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
def register_metrics(registry: Registry) -> None:
    registry.add("psnr", "splatwizard_core.evaluation.image:psnr",
                 summary="peak signal-to-noise ratio, dB, joint over channels", direction="higher")  # fmt: skip
    registry.add("ssim", "splatwizard_core.evaluation.image:ssim",
                 summary="structural similarity, 11x11 Gaussian window, zero padding", direction="higher")  # fmt: skip
    registry.add("l1", "splatwizard_core.evaluation.image:l1",
                 summary="mean absolute error", direction="lower")  # fmt: skip
    for name, target, summary in (
        ("lpips_vgg_3dgs", "VGG_3DGS", "LPIPS, VGG16 fed with 0..1 as the 3DGS code does: the one in most tables"),
        ("lpips_vgg", "VGG", "LPIPS, VGG16, images mapped to -1..1"),
        ("lpips_alex", "ALEX", "LPIPS, AlexNet, images mapped to -1..1"),
    ):
        registry.add(name, f"splatwizard_core.evaluation.perceptual:{target}", summary=summary, direction="lower",
                     slow=True)  # fmt: skip
    registry.add("psnr_channel_mean", "splatwizard_core.evaluation.image:psnr_channel_mean",
                 summary="mean of the channels' PSNRs, dB: never below psnr", direction="higher",
                 diagnostic=True)  # fmt: skip
    registry.add("psnr_unrounded", "splatwizard_core.evaluation.image:psnr",
                 summary="psnr of the render before it is rounded to 8 bit, dB", direction="higher",
                 diagnostic=True, unrounded=True)  # fmt: skip
    registry.add("ssim_valid", "splatwizard_core.evaluation.image:ssim_valid",
                 summary="ssim without the border, as scikit-image averages", direction="higher",
                 diagnostic=True)  # fmt: skip
    registry.add("ssim_reflect", "splatwizard_core.evaluation.image:ssim_reflect",
                 summary="ssim of the picture mirrored at its edge, as torchmetrics averages", direction="higher",
                 diagnostic=True)  # fmt: skip


@hookimpl
def register_exporters(registry: Registry) -> None:
    registry.add("ply", "splatwizard_core.gaussians.ply:export_ply",
                 summary="3DGS .ply, float32, as the original viewers read it", suffix=".ply")  # fmt: skip
