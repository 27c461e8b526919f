"""Registers the method of this package."""

from splatwizard_core.api import Registry, hookimpl


@hookimpl
def register_methods(registry: Registry) -> None:
    registry.add("test-distill", "sw_test_distill.method:TestDistill", summary="proof of the contracts: two stages")
