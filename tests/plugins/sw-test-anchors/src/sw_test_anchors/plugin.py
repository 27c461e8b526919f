"""Registration of the method test-anchors."""

from splatwizard_core.api import Registry, hookimpl


@hookimpl
def register_methods(registry: Registry) -> None:
    registry.add("test-anchors", "sw_test_anchors.method:TestAnchors", summary="proof of the contracts: anchors")
