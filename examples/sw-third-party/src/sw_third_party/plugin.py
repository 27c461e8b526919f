"""Registers the method of this package."""

from splatwizard_core.api import Registry, hookimpl


@hookimpl
def register_methods(registry: Registry) -> None:
    registry.add(
        "opacity-prune",
        "sw_third_party.method:OpacityPrune",
        summary="example: train 3DGS, drop the most transparent Gaussians, train on",
    )
