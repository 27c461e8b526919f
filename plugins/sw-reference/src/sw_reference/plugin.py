"""Registration of the rasterizer `reference`."""

from splatwizard_core.api import Registry, hookimpl


@hookimpl
def register_rasterizers(registry: Registry) -> None:
    registry.add(
        "reference",
        "sw_reference.rasterizer:ReferenceRasterizer",
        summary="pure-torch oracle of 3DGS and 2DGS: any device, float64, slow",
        devices=["cpu", "cuda"],
        dtypes=["float32", "float64"],
        features=[
            "BACKWARD", "ANTIALIAS", "ABSGRAD", "VISIBLE_FILTER", "COV3D", "COLORS_ND", "EXTRA_FEATURES",
            "SPLIT_SH", "INDEXED_SH", "INDEXED_GEOM", "NO_COLOR_CLAMP", "DEPTH_INVERSE", "DEPTH_ACCUM",
            "DEPTH_EXPECTED", "DEPTH_MEDIAN", "ALPHA_MAP", "SCORE_HITS", "SCORE_OPACITY", "SCORE_OPACITY_T",
            "SCORE_BLEND", "SCORE_BLEND_SQ", "SCORE_BLEND_MAX", "SCORE_SHOWN", "SCORE_GAMMA", "SCORE_DIST",
            "SCORE_PIXEL_WEIGHT", "SCORE_GRAD_SQ", "SCORE_REMOVAL", "FISHER", "FLOAT64", "SURFEL", "NORMALS",
            "DISTORTION", "DETERMINISTIC",
        ],
        # Surfels have a low-pass of their own, and the scores are those of ellipsoids.
        combos_forbidden=[
            ["SURFEL", other]
            for other in (
                "ANTIALIAS", "ABSGRAD", "SCORE_HITS", "SCORE_OPACITY", "SCORE_OPACITY_T", "SCORE_BLEND",
                "SCORE_BLEND_SQ", "SCORE_BLEND_MAX", "SCORE_SHOWN", "SCORE_GAMMA", "SCORE_DIST", "SCORE_GRAD_SQ",
                "SCORE_REMOVAL", "FISHER",
            )
        ] + [["COV3D", "FISHER"]],
        profiles=["3dgs", "dgr-exact"],
        exactness="exact",
        speed=0,
    )  # fmt: skip
