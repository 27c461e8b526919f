"""Registers the method speedy-splat, and its score as a pruner for any method."""

from splatwizard_core.api import Registry, hookimpl


@hookimpl
def register_methods(registry: Registry) -> None:
    registry.add("speedy-splat", "sw_speedy_splat.method:SpeedySplat", title="Speedy-Splat",
                 summary="3DGS pruned hard while and after it densifies (Hanson et al. 2025)",
                 presets=["paper", "inria", "quick"],
                 rates=["r1", "r2", "r3", "r4", "r5", "r6"],
                 published="sw_speedy_splat:published.toml")  # fmt: skip


@hookimpl
def register_pruners(registry: Registry) -> None:
    registry.add("speedy-splat", "sw_speedy_splat.score:SpeedyScore",
                 summary="keeps what pictures change with: squared derivatives by a Gaussian's value")  # fmt: skip
