"""Entries of this package: the method cat-3dgs, and the context model that its files name."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from splatwizard_core.api import Registry, hookimpl

if TYPE_CHECKING:
    from collections.abc import Callable

    from splatwizard_core.api import ContextModel, EntropyModel
    from sw_cat_3dgs.plane_coder import PlaneCoder
    from sw_cat_3dgs.spatial_ar import SpatialAr

    # mypy holds each class that is registered below to its contract.
    ENTROPY_MODEL: Callable[..., EntropyModel] = PlaneCoder
    CONTEXT_MODEL: Callable[..., ContextModel] = SpatialAr


@hookimpl
def register_methods(registry: Registry[Any]) -> None:
    registry.add("cat-3dgs", "sw_cat_3dgs.method:Cat3DGS", title="CAT-3DGS",
                 summary="anchors under a triplane context, autoregressive over channels (Zhan et al. 2025)",
                 presets=["paper", "tandt", "db", "bungee", "quick"],
                 rates=["r1", "r2", "r3", "r4", "r5", "r6"],
                 native="sw_anchors.native:ANCHORS",
                 published="sw_cat_3dgs:published.toml")  # fmt: skip


@hookimpl
def register_entropy_models(registry: Registry[Any]) -> None:
    registry.add("wavefront", "sw_cat_3dgs.plane_coder:PlaneCoder",
                 summary="integer planes, each value from its neighbours in exact integers, along wavefronts",
                 native="sw_codecs.exact_native:EXACT")  # fmt: skip


@hookimpl
def register_context_models(registry: Registry[Any]) -> None:
    registry.add("spatial-ar", "sw_cat_3dgs.spatial_ar:SpatialAr",
                 summary="mean and scale of each integer of a plane from twelve causal neighbours")  # fmt: skip
