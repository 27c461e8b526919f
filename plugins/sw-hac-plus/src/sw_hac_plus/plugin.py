"""Registration of the method hac-plus."""

from splatwizard_core.api import Registry, hookimpl


@hookimpl
def register_methods(registry: Registry) -> None:
    registry.add("hac-plus", "sw_hac_plus.method:HACPlus", title="HAC++",
                 summary="HAC with channels that predict one another, pruned by the rate (Chen et al. 2025)",
                 presets=["paper", "quick"],
                 rates=["r1", "r2", "r3", "r4", "r5"], bd_anchor=1,
                 native=["sw_anchors.native:ANCHORS", "sw_codecs.native:CODECS"],
                 published="sw_hac_plus:published.toml")  # fmt: skip
