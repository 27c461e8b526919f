"""Registers the method trimming-the-fat, and its rule as a pruner for any method."""

from splatwizard_core.api import Registry, hookimpl


@hookimpl
def register_methods(registry: Registry) -> None:
    registry.add("trimming-the-fat", "sw_trimming_the_fat.method:TrimmingTheFat", title="Trimming the Fat",
                 summary="prunes a trained 3DGS scene by opacity and gradient, ten times (Ali et al. 2024)",
                 presets=["paper", "official", "quick"],
                 rates=["r1", "r2", "r3", "r4", "r5", "r6"])  # fmt: skip


@hookimpl
def register_pruners(registry: Registry) -> None:
    registry.add("trimming-the-fat", "sw_trimming_the_fat.score:OpacityAndGradient",
                 summary="keeps what is opaque or moves on screen; reads gradient statistics")  # fmt: skip
