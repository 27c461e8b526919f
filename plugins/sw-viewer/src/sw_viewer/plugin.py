"""Registers `sw view` and the exporter of the one-file page."""

from splatwizard_core.api import Registry, hookimpl


@hookimpl
def register_commands(registry: Registry) -> None:
    registry.add("view", "sw_viewer.command:view", position=4.6, summary="look at decoded models in the browser")


@hookimpl
def register_exporters(registry: Registry) -> None:
    registry.add("html", "sw_viewer.page_file:export_page", suffix=".html",
                 summary="one page that shows the Gaussians in any browser, offline")  # fmt: skip
