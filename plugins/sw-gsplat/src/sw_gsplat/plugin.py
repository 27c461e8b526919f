"""Registration of the rasterizer `gsplat`."""

from splatwizard_core.api import Registry, hookimpl


@hookimpl
def register_rasterizers(registry: Registry) -> None:
    registry.add(
        "gsplat",
        "sw_gsplat.rasterizer:GsplatRasterizer",
        summary="the public gsplat 1.5 (Apache-2.0), alpha clamped at 0.999 instead of 0.99",
        devices=["cuda"],
        dtypes=["float32"],
        features=[
            "BACKWARD", "ANTIALIAS", "ABSGRAD", "COV3D", "COLORS_ND", "DEPTH_ACCUM", "DEPTH_EXPECTED", "ALPHA_MAP",
            "TIGHT_TILES",
        ],
        available="sw_gsplat.availability:unavailable",
        profiles=["3dgs"],
        exactness="tight",
        speed=40,
        alpha_max=0.999,
    )  # fmt: skip
