"""Registers `sw lod`, and the codec that writes a scene in tiles."""

from __future__ import annotations

from typing import Any

from splatwizard_core.api import Registry, hookimpl


@hookimpl
def register_commands(registry: Registry[Any]) -> None:
    registry.add("lod", "sw_lod.command:lod", position=4.3, summary="a scene in pieces and levels, for streaming")


@hookimpl
def register_coders(registry: Registry[Any]) -> None:
    registry.add("gaussians-tiles", "sw_lod.tiles:Tiles", codes="gaussians", prefixes="",
                 summary="whole Gaussian models, coarse first, then place by place")  # fmt: skip
