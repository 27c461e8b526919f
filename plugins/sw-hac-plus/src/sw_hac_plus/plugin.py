"""Registration of the method hac-plus and of its context model."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from splatwizard_core.api import Registry, hookimpl

if TYPE_CHECKING:
    from collections.abc import Callable

    from splatwizard_core import api
    from sw_hac_plus.channel_mixture import ChannelMixture

    # mypy holds the class that is registered below to its contract.
    CONTEXT_MODELS: list[Callable[..., api.ContextModel]] = [ChannelMixture]


@hookimpl
def register_context_models(registry: Registry[Any]) -> None:
    registry.add("channel-mixture", "sw_hac_plus.channel_mixture:ChannelMixture",
                 summary="a second Gaussian for each channel, from the slices before it")  # fmt: skip


@hookimpl
def register_methods(registry: Registry[Any]) -> None:
    registry.add("hac-plus", "sw_hac_plus.method:HACPlus", title="HAC++",
                 summary="HAC with channels that predict one another, pruned by the rate (Chen et al. 2025)",
                 presets=["paper", "quick"],
                 rates=["r1", "r2", "r3", "r4", "r5"], bd_anchor=1,
                 native=["sw_anchors.native:ANCHORS", "sw_codecs.native:CODECS", "sw_hac.native:HAC"],
                 published="sw_hac_plus:published.toml")  # fmt: skip
