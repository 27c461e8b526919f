"""Registers the method 2dgs."""

from splatwizard_core.api import Registry, hookimpl


@hookimpl
def register_methods(registry: Registry) -> None:
    registry.add("2dgs", "sw_2dgs.method:TwoDGS", title="2DGS",
                 summary="2D Gaussian Splatting (Huang et al. 2024): surfels, for surfaces and meshes",
                 presets=["paper", "quick"],
                 rates=["r1", "r2", "r3", "r4", "r5", "r6"], bd_anchor=3,
                 published="sw_2dgs:published.toml")  # fmt: skip
