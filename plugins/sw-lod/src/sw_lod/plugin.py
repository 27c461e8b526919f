"""Registers `sw lod`."""

from splatwizard_core.api import Registry, hookimpl


@hookimpl
def register_commands(registry: Registry) -> None:
    registry.add("lod", "sw_lod.command:lod", position=4.3, summary="a scene in pieces and levels, for streaming")
