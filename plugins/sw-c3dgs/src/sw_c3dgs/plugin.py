"""Registers the method c3dgs, its sensitivity as a pruner, and its file for anybody."""

from splatwizard_core.api import Registry, hookimpl


@hookimpl
def register_methods(registry: Registry) -> None:
    registry.add("c3dgs", "sw_c3dgs.method:C3DGS", title="C3DGS",
                 summary="C3DGS (Niedermayr et al. 2024): codebooks of colours and shapes by sensitivity, 8 bits",
                 presets=["paper", "quick"], rates=["r1", "r2", "r3", "r4", "r5"], training_free=True,
                 published="sw_c3dgs:published.toml")  # fmt: skip


@hookimpl
def register_pruners(registry: Registry) -> None:
    registry.add("sensitivity", "sw_c3dgs.sensitivity:Sensitivity",
                 summary="keeps what the training pictures react to most")  # fmt: skip


@hookimpl
def register_coders(registry: Registry) -> None:
    registry.add("gaussians-indexed", "sw_c3dgs.codec:IndexedCodec", codes="gaussians",
                 summary="whole Gaussian models: codebooks of colours and shapes, 8 bits, DEFLATE")  # fmt: skip
