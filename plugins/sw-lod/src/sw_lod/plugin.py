"""Registers `sw lod` and `sw truncate`, and the codec that writes a scene in tiles."""

from __future__ import annotations

from typing import Any

from splatwizard_core.api import Registry, hookimpl


@hookimpl
def register_commands(registry: Registry[Any]) -> None:
    registry.add("lod", "sw_lod.command:lod", position=4.3, summary="a scene in pieces and levels, for streaming")
    registry.add(
        "truncate", "sw_lod.truncate_command:truncate", position=3.5, summary="a shorter file of one with cuts"
    )


@hookimpl
def register_coders(registry: Registry[Any]) -> None:
    registry.add("gaussians-tiles", "sw_lod.tiles:Tiles", codes="gaussians", prefixes="",
                 summary="whole Gaussian models, coarse first, then place by place")  # fmt: skip
