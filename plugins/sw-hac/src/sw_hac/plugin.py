"""Registration of the method hac."""

from splatwizard_core.api import Registry, hookimpl


@hookimpl
def register_methods(registry: Registry) -> None:
    registry.add("hac", "sw_hac.method:HAC", title="HAC",
                 summary="anchors whose attributes a binary hash grid predicts (Chen et al. 2024)",
                 presets=["paper", "quick"],
                 rates=["r1", "r2", "r3", "r4", "r5"], bd_anchor=1,
                 native=["sw_anchors.native:ANCHORS", "sw_codecs.native:CODECS"],
                 published="sw_hac:published.toml")  # fmt: skip
