"""Registers the method opacity-prune."""

from splatwizard_core.api import Registry, hookimpl


@hookimpl
def register_methods(registry: Registry) -> None:
    registry.add(
        "opacity-prune",
        "sw_third_party.method:OpacityPrune",
        summary="example: drop the most transparent Gaussians of a trained 3DGS scene, train on",
        presets=["paper", "quick"],
        rates=["r1", "r2", "r3"],
    )
