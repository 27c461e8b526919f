"""Registers the commands `sw config`, `sw new-plugin` and `sw check-plugin`."""

from splatwizard_core.api import Registry, hookimpl


@hookimpl
def register_commands(registry: Registry) -> None:
    registry.add("config", "sw_kit.config_command:config", position=6.5, summary="every key of --set for a method")
    registry.add("new-plugin", "sw_kit.new_plugin:new_plugin", position=30,
                 summary="start a package: a method, a codec, a metric, ...")  # fmt: skip
    registry.add("check-plugin", "sw_kit.check_plugin:check_plugin", position=31,
                 summary="hold a package to the contracts")  # fmt: skip
