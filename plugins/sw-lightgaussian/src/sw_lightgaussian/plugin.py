"""What this package provides: the method lightgaussian, its score as a pruner, and its two coders for anybody."""

from splatwizard_core.plugins import Registry, hookimpl


@hookimpl
def register_coders(registry: Registry) -> None:
    registry.add("importance-vq", "sw_lightgaussian.importance_vq:ImportanceVQ",
                 summary="float vectors: a codebook for the least important, float16 for the rest")  # fmt: skip
