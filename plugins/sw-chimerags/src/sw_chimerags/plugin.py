"""Registers the method chimerags; its parts are asked for by name from the packages that have them."""

from splatwizard_core.api import Registry, hookimpl


@hookimpl
def register_methods(registry: Registry) -> None:
    registry.add("chimerags", "sw_chimerags.method:ChimeraGS", title="ChimeraGS",
                 summary="Speedy-Splat's training, masked distillation, vectors by importance, fast renderers",
                 presets=["paper", "inria", "quick"],
                 rates=["r1", "r2", "r3", "r4"])  # fmt: skip
