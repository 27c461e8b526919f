"""Registers the method compact3dgs; the volume mask is in sw-gaussians, codebooks and coders are in sw-codecs."""

from splatwizard_core.api import Registry, hookimpl


@hookimpl
def register_methods(registry: Registry) -> None:
    registry.add("compact3dgs", "sw_compact3dgs.method:Compact3DGS", title="Compact3DGS",
                 summary="learned volume mask, colours of a hash grid and a network, residual codebooks of shapes",
                 presets=["paper", "inria", "synthetic", "quick"],
                 rates=["r1", "r2", "r3", "r4", "r5", "r6", "r7"],
                 published="sw_compact3dgs:published.toml")  # fmt: skip
