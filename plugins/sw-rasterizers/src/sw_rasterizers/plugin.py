"""Registration of the compiled rasterizers."""

from splatwizard_core.api import Registry, hookimpl

PROFILES = ["3dgs", "dgr-exact"]
"""Profiles: `3dgs` has exact splat support, `dgr-exact` the tiles and gradients of the original code."""

STANDARD_FEATURES = [
    "BACKWARD", "ANTIALIAS", "ABSGRAD", "VISIBLE_FILTER", "COV3D", "COLORS_ND", "EXTRA_FEATURES", "SPLIT_SH",
    "NO_COLOR_CLAMP", "DEPTH_INVERSE", "DEPTH_ACCUM", "DEPTH_EXPECTED", "DEPTH_MEDIAN", "ALPHA_MAP", "TIGHT_TILES",
    "FLOAT64", "DETERMINISTIC", "FRAGMENT_GRAD",
]  # fmt: skip

SCORES = [
    "SCORE_HITS", "SCORE_OPACITY", "SCORE_OPACITY_T", "SCORE_BLEND", "SCORE_BLEND_SQ", "SCORE_BLEND_MAX",
    "SCORE_SHOWN", "SCORE_GAMMA", "SCORE_DIST", "SCORE_PIXEL_WEIGHT", "SCORE_GRAD_SQ", "SCORE_REMOVAL", "FISHER",
]  # fmt: skip
# A derivative of three colours, without that of the antialias factor; log scales need scales.
SCORES_FORBIDDEN = [
    ["COLORS_ND", "SCORE_GRAD_SQ"], ["COLORS_ND", "SCORE_REMOVAL"], ["COLORS_ND", "FISHER"], ["ANTIALIAS", "FISHER"],
    ["COV3D", "FISHER"],
]  # fmt: skip
ALIASES = ["accel", "depth", "count", "speedy", "pup", "mesongs", "trimgs"]
"""Rasterizers of papers whose additions `standard` has: Taming 3DGS, hierarchical 3DGS, LightGaussian, Speedy-Splat,
PUP 3D-GS, MesonGS, TrimGS."""

ON_CUDA = {"lacks": ["FLOAT64"], "available": "sw_rasterizers.native:unavailable_on_cuda"}
# Name -> (target, summary, features, speed). The speed only ranks `c3dgs` below `standard`, codebooks excepted.
STANDARD = {
    "standard": (
        "standard:StandardRasterizer",
        "compiled 3DGS rasterizer with scores of Gaussians: CPU, vectorised and multi-threaded, and CUDA",
        [*STANDARD_FEATURES, *SCORES],
        50,
    ),
    "c3dgs": (
        "variants:IndexedRasterizer",
        "compiled 3DGS rasterizer that reads codebooks of colours and shapes (C3DGS)",
        [*STANDARD_FEATURES, "INDEXED_SH", "INDEXED_GEOM"],
        42,
    ),
}  # fmt: skip

SURFEL_FEATURES = [
    "SURFEL", "BACKWARD", "VISIBLE_FILTER", "SPLIT_SH", "NO_COLOR_CLAMP", "NORMALS", "DISTORTION", "DEPTH_INVERSE",
    "DEPTH_ACCUM", "DEPTH_EXPECTED", "DEPTH_MEDIAN", "ALPHA_MAP", "TIGHT_TILES", "FLOAT64", "DETERMINISTIC",
]  # fmt: skip

INFERENCE_FEATURES = [
    "ANTIALIAS", "VISIBLE_FILTER", "COV3D", "SPLIT_SH", "NO_COLOR_CLAMP", "ALPHA_MAP", "TIGHT_TILES", "UINT8_OUT",
]  # fmt: skip
# Name -> (target, summary, exactness, speed): forward only. Whoever asks must accept the exactness.
INFERENCE = {
    "flash": ("FlashRasterizer", "FlashGS-style, polynomial exponents, 8-bit images", "approx-uint8", 55),
    "tcgs": ("TensorCoreRasterizer", "TC-GS-style, exponents by tensor cores", "approx-fp16", 60),
}


@hookimpl
def register_rasterizers(registry: Registry) -> None:
    of = {"standard": {"aliases": ALIASES, "combos_forbidden": SCORES_FORBIDDEN}, "c3dgs": {"kernels": "standard"}}
    for name, (target, summary, features, speed) in STANDARD.items():
        registry.add(
            name,
            f"sw_rasterizers.{target}",
            summary=summary,
            devices=["cpu", "cuda"],
            dtypes=["float32", "float64"],
            features=features,
            available="sw_rasterizers.native:unavailable",
            on={"cuda": ON_CUDA},
            profiles=PROFILES,
            exactness="exact",
            speed=speed,
            native="sw_rasterizers.native:MODULE",
            **of[name],
        )
    registry.add(
        "2dgs",
        "sw_rasterizers.surfel:SurfelRasterizer",
        summary="compiled rasterizer of surfels (2DGS): CPU, vectorised and multi-threaded, and CUDA",
        devices=["cpu", "cuda"],
        dtypes=["float32", "float64"],
        features=SURFEL_FEATURES,
        needs=["SURFEL"],
        available="sw_rasterizers.native:unavailable",
        on={"cuda": ON_CUDA},
        profiles=PROFILES,
        exactness="exact",
        speed=50,
        native="sw_rasterizers.native:MODULE",
    )
    for name, (target, summary, exactness, speed) in INFERENCE.items():
        registry.add(
            name,
            f"sw_rasterizers.inference:{target}",
            summary=f"approximate 3DGS rasterizer for inference on CUDA: {summary}",
            devices=["cuda"],
            dtypes=["float32"],
            features=INFERENCE_FEATURES,
            available="sw_rasterizers.native:unavailable_on_cuda",
            profiles=PROFILES,
            exactness=exactness,
            speed=speed,
            min_cc=[8, 0],  # copies past the registers and products of tensor cores
            native="sw_rasterizers.native:MODULE",
        )
