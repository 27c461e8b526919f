"""Names of the maps: what can be asked for. Apart from the drawing, which imports torch."""

from __future__ import annotations

from collections.abc import Mapping

DRAWN: Mapping[str, str] = {
    "expected": "mean z of what the ray meets",
    "median": "z of what the ray meets where half of the light is gone",
    "inverse": "sum of weight / z",
    "accumulated": "sum of weight * z",
}
"""Depth modes that rasterizers draw -> meaning."""

RENDERED, SURFACE = "rendered", "surface"
DEPTHS = (*DRAWN, SURFACE)
"""All depth modes; "surface" is (1 - r) expected + r median of surfels, with the r of their training."""

NORMALS = (RENDERED, SURFACE)
"""Normals of the surfels, blended; or those of the surface that the depth describes."""

AUTO = "auto"
"""The first of NORMALS that a model has."""
