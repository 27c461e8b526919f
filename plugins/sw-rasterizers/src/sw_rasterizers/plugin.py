"""What this package provides."""

from splatwizard_core.plugins import Registry, hookimpl

STANDARD_FEATURES = [
    "BACKWARD", "ANTIALIAS", "ABSGRAD", "VISIBLE_FILTER", "COV3D", "COLORS_ND", "EXTRA_FEATURES", "SPLIT_SH",
    "NO_COLOR_CLAMP", "DEPTH_INVERSE", "DEPTH_ACCUM", "DEPTH_EXPECTED", "DEPTH_MEDIAN", "ALPHA_MAP", "TIGHT_TILES",
    "FLOAT64", "DETERMINISTIC",
]  # fmt: skip

SURFEL_FEATURES = [
    "SURFEL", "BACKWARD", "VISIBLE_FILTER", "SPLIT_SH", "NO_COLOR_CLAMP", "NORMALS", "DISTORTION", "DEPTH_INVERSE",
    "DEPTH_ACCUM", "DEPTH_EXPECTED", "DEPTH_MEDIAN", "ALPHA_MAP", "TIGHT_TILES", "FLOAT64", "DETERMINISTIC",
]  # fmt: skip


@hookimpl
def register_rasterizers(registry: Registry) -> None:
    registry.add(
        "standard",
        "sw_rasterizers.standard:StandardRasterizer",
        summary="compiled 3DGS rasterizer: CPU, vectorised and multi-threaded, and CUDA",
        devices=["cpu", "cuda"],
        dtypes=["float32", "float64"],
        features=STANDARD_FEATURES,
        available="sw_rasterizers.native:unavailable",
        # Sums over pixels are atomic there: their order, and so their last bits, vary from run to run.
        on={"cuda": {"lacks": ["FLOAT64", "DETERMINISTIC"], "available": "sw_rasterizers.native:unavailable_on_cuda"}},
        exactness="exact",
        speed=50,
        native="sw_rasterizers.native:MODULE",
    )
    registry.add(
        "2dgs",
        "sw_rasterizers.surfel:SurfelRasterizer",
        summary="compiled rasterizer of surfels (2DGS): CPU, vectorised and multi-threaded",
        devices=["cpu"],
        dtypes=["float32", "float64"],
        features=SURFEL_FEATURES,
        needs=["SURFEL"],
        available="sw_rasterizers.native:unavailable",
        exactness="exact",
        speed=50,
        native="sw_rasterizers.native:MODULE",
    )
