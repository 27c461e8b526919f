"""Registration of the command `sw render`."""

from splatwizard_core.api import Registry, hookimpl


@hookimpl
def register_commands(registry: Registry) -> None:
    registry.add("render", "sw_render.command:render", position=4.5,
                 summary="draw an encoded scene: pictures, depth, normals")  # fmt: skip
