"""Registers the method wisp, and its parts: entropy model, context model, position codec."""

from splatwizard_core.api import Registry, hookimpl


@hookimpl
def register_methods(registry: Registry) -> None:
    registry.add("wisp", "sw_wisp.method:Wisp", title="Wisp",
                 summary="explicit splats coded as residuals against those before them, removed by what pictures lose",
                 prefixes="", presets=["paper", "fast", "quick"], rates=["r1", "r2", "r3", "r4", "r5"],
                 native=["sw_codecs.exact_native:EXACT", "sw_wisp.fast.exact_native:EXACT",
                         "sw_wisp.fast.native:WISP"])  # fmt: skip


@hookimpl
def register_entropy_models(registry: Registry) -> None:
    registry.add("nested-gaussian", "sw_wisp.nested_model:NestedGaussian",
                 summary="integers under Gaussians, at once or coarse first and refined later")  # fmt: skip


@hookimpl
def register_context_models(registry: Registry) -> None:
    registry.add("pyramid", "sw_wisp.pyramid_model:PyramidModel",
                 summary="numbers of each splat from running means of those before it around its place")  # fmt: skip


@hookimpl
def register_coders(registry: Registry) -> None:
    registry.add("leaf-octree", "sw_wisp.leaf_octree:LeafOctree", codes="positions",
                 summary="point positions as octree occupancy, by the cells beside each")  # fmt: skip
