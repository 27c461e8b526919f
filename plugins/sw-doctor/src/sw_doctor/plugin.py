"""Registers the commands that get a machine ready: `sw doctor` and `sw build-kernels`."""

from splatwizard_core.api import Registry, hookimpl


@hookimpl
def register_commands(registry: Registry) -> None:
    registry.add("doctor", "sw_doctor.command:doctor", position=20,
                 summary="what works here, and what to install for the rest")  # fmt: skip
    registry.add("completion", "sw_doctor.completion_command:completion", position=9, completes=True,
                 summary="completion for bash, zsh or fish")  # fmt: skip
    registry.add("build-kernels", "sw_doctor.build_kernels:build_kernels", position=10,
                 summary="compile all native modules ahead of time")  # fmt: skip
