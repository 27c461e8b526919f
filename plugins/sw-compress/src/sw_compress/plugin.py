"""Registers `sw compress`."""

from splatwizard_core.api import Registry, hookimpl


@hookimpl
def register_commands(registry: Registry) -> None:
    registry.add(
        "compress",
        "sw_compress.command:compress",
        position=4.2,
        summary="any splat file to a size, without photographs",
    )
