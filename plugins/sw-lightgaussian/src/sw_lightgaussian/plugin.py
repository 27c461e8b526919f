"""Registers the method lightgaussian, its score as a pruner, and its two coders for anybody."""

from splatwizard_core.api import Registry, hookimpl


@hookimpl
def register_methods(registry: Registry) -> None:
    registry.add("lightgaussian", "sw_lightgaussian.method:LightGaussian", title="LightGaussian",
                 summary="LightGaussian (Fan et al. 2024): prune, distil to SH degree 2, vector-quantise",
                 presets=["paper", "quick"], rates=["r1", "r2", "r3", "r4", "r5"], training_free=True, bd_anchor=2,
                 published="sw_lightgaussian:published.toml")  # fmt: skip


@hookimpl
def register_pruners(registry: Registry) -> None:
    registry.add("lightgaussian", "sw_lightgaussian.significance:Significance",
                 summary="keeps what is opaque, seen in many pixels and large")  # fmt: skip


@hookimpl
def register_coders(registry: Registry) -> None:
    registry.add("importance-vq", "sw_lightgaussian.importance_vq:ImportanceVQ", codes="vectors",
                 summary="float vectors: a codebook for the least important, float16 for the rest")  # fmt: skip
    registry.add("vectree", "sw_lightgaussian.vectree:VecTree", codes="gaussians",
                 summary="whole Gaussian models: exact positions, vector-quantised colours")  # fmt: skip
