"""Registers importers and exporters of the formats that other programs use."""

from splatwizard_core.api import Registry, hookimpl


@hookimpl
def register_exporters(registry: Registry) -> None:
    registry.add("splat", "sw_interchange.registered:export_splat", suffix=".splat",
                 summary=".splat: 32 bytes a Gaussian, no SH")  # fmt: skip


@hookimpl
def register_importers(registry: Registry) -> None:
    registry.add("splat", "sw_interchange.registered:import_splat", suffix=".splat",
                 summary=".splat: 32 bytes a Gaussian, no SH")  # fmt: skip
