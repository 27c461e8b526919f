"""What this package provides."""

from splatwizard_core.plugins import Registry, hookimpl


@hookimpl
def register_methods(registry: Registry) -> None:
    registry.add(
        "opacity-prune",
        "sw_third_party.method:OpacityPrune",
        summary="example: train 3DGS, drop the most transparent Gaussians, train on",
    )
