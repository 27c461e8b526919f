"""Registers the method mesongs, and its score as a pruner for any method."""

from splatwizard_core.api import Registry, hookimpl


@hookimpl
def register_methods(registry: Registry) -> None:
    registry.add("mesongs", "sw_mesongs.method:MesonGS", title="MesonGS",
                 summary="MesonGS (Xie et al. 2024): prune, octree, RAHT, codebook, fine-tune what is decoded",
                 presets=["paper", "nerf_synthetic", "mipnerf360", "tandt", "db", "quick"],
                 rates=["r1", "r2", "r3", "r4"],
                 published="sw_mesongs:published.toml")  # fmt: skip


@hookimpl
def register_pruners(registry: Registry) -> None:
    registry.add("mesongs", "sw_mesongs.importance:Importance",
                 summary="keeps what contributes to many pixels and is large")  # fmt: skip
