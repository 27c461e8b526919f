"""Registers the command `sw doctor`."""

from splatwizard_core.api import Registry, hookimpl


@hookimpl
def register_commands(registry: Registry) -> None:
    registry.add("doctor", "sw_doctor.command:doctor", position=20,
                 summary="what works here, and what to install for the rest")  # fmt: skip
