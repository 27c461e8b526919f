"""Registers the methods 3dgs and pruned-3dgs."""

from splatwizard_core.api import Registry, hookimpl


@hookimpl
def register_methods(registry: Registry) -> None:
    registry.add("3dgs", "sw_3dgs.method:ThreeDGS", title="3DGS",
                 summary="3D Gaussian Splatting (Kerbl et al. 2023), float32 or quantised",
                 default=True, presets=["paper", "inria", "inria2024", "absgrad", "mcmc", "fast", "fast-cpu", "quick"],
                 rates=["r1", "r2", "r3", "r4", "r5", "r6"], training_free=True, bd_anchor=3,
                 published="sw_3dgs:published.toml", prefixes="codec.settings.prefixes=8")  # fmt: skip
    registry.add("pruned-3dgs", "sw_3dgs.pruned:Pruned3DGS", title="3DGS, pruned",
                 summary="a trained 3DGS scene with as many Gaussians as asked for, by the exact cost of removal",
                 presets=["paper", "quick"], rates=["r1", "r2", "r3", "r4", "r5"])  # fmt: skip
