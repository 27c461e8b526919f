"""Registration of the method hac and of its context model."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from splatwizard_core.api import Registry, hookimpl

if TYPE_CHECKING:
    from collections.abc import Callable

    from splatwizard_core import api
    from sw_hac.mixed_grid import MixedHashGrid

    # mypy holds the class that is registered below to its contract.
    CONTEXT_MODELS: list[Callable[..., api.ContextModel]] = [MixedHashGrid]


@hookimpl
def register_context_models(registry: Registry[Any]) -> None:
    registry.add("hash-grid", "sw_hac.mixed_grid:MixedHashGrid",
                 summary="learned signs on grids of many resolutions, looked up by position")  # fmt: skip


@hookimpl
def register_methods(registry: Registry[Any]) -> None:
    registry.add("hac", "sw_hac.method:HAC", title="HAC",
                 summary="anchors whose attributes a binary hash grid predicts (Chen et al. 2024)",
                 presets=["paper", "quick"],
                 rates=["r1", "r2", "r3", "r4", "r5"], bd_anchor=1,
                 native=["sw_anchors.native:ANCHORS", "sw_codecs.native:CODECS", "sw_hac.native:HAC"],
                 published="sw_hac:published.toml")  # fmt: skip
