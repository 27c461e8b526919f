"""Entries of this package: the method cat-3dgs, and the context model that its files name."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from splatwizard_core.api import Registry, hookimpl

if TYPE_CHECKING:
    from splatwizard_core.api import ContextModel
    from sw_cat_3dgs.spatial_ar import SpatialAr

    _: type[ContextModel] = SpatialAr  # mypy holds it to the contract


@hookimpl
def register_methods(registry: Registry[Any]) -> None:
    registry.add("cat-3dgs", "sw_cat_3dgs.method:Cat3DGS", title="CAT-3DGS",
                 summary="anchors under a triplane context, autoregressive over channels (Zhan et al. 2025)",
                 presets=["paper", "tandt", "db", "bungee", "quick"],
                 rates=["r1", "r2", "r3", "r4", "r5", "r6"],
                 native="sw_anchors.native:ANCHORS",
                 published="sw_cat_3dgs:published.toml")  # fmt: skip


@hookimpl
def register_context_models(registry: Registry[Any]) -> None:
    registry.add("spatial-ar", "sw_cat_3dgs.spatial_ar:SpatialAr",
                 summary="integers of a plane from their causal neighbours, coded along wavefronts")  # fmt: skip
