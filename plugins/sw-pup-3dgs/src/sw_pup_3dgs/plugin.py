"""Registers the method pup-3dgs, and its score as a pruner for any method."""

from splatwizard_core.api import Registry, hookimpl


@hookimpl
def register_methods(registry: Registry) -> None:
    registry.add("pup-3dgs", "sw_pup_3dgs.method:Pup3DGS", title="PUP-3DGS",
                 summary="removes 90 % of a trained 3DGS scene by its Fisher information (Hanson et al. 2025)",
                 presets=["paper", "splatwizard", "quick"],
                 rates=["r1", "r2", "r3", "r4", "r5", "r6"],
                 published="sw_pup_3dgs:published.toml")  # fmt: skip


@hookimpl
def register_pruners(registry: Registry) -> None:
    registry.add("pup-3dgs", "sw_pup_3dgs.score:FisherScore",
                 summary="keeps what views react to: log det of the Fisher block of mean and log scale")  # fmt: skip
