"""Registration of the commands `sw render` and `sw bake`."""

from splatwizard_core.api import Registry, hookimpl


@hookimpl
def register_commands(registry: Registry) -> None:
    registry.add("render", "sw_render.command:render", position=4.5,
                 summary="draw an encoded scene: pictures, depth, normals")  # fmt: skip
    registry.add("bake", "sw_render.bake_command:bake", position=4.6,
                 summary="make explicit Gaussians of anchors, for viewers")  # fmt: skip
