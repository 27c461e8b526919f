"""Registration of the method cat-3dgs."""

from splatwizard_core.api import Registry, hookimpl


@hookimpl
def register_methods(registry: Registry) -> None:
    registry.add("cat-3dgs", "sw_cat_3dgs.method:Cat3DGS", title="CAT-3DGS",
                 summary="anchors under a triplane context, autoregressive over channels (Zhan et al. 2025)",
                 presets=["paper", "tandt", "db", "bungee", "quick"],
                 rates=["r1", "r2", "r3", "r4", "r5", "r6"],
                 native="sw_anchors.native:ANCHORS",
                 published="sw_cat_3dgs:published.toml")  # fmt: skip
