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
DEPTHS: Mapping[str, str] = {**DRAWN, SURFACE: "(1 - depth_ratio) expected + depth_ratio median, of surfels"}
"""All depth modes -> meaning; the ratio is that of the training."""

NORMALS: Mapping[str, str] = {
    RENDERED: "normals of the surfels, blended",
    SURFACE: "normals of the surface that the depth describes",
}
"""Kinds of normals -> meaning."""

AUTO = "auto"
"""The first of NORMALS that a model has."""

PATHS: Mapping[str, str] = {
    "orbit": "a circle around what the training cameras look at",
    "spiral": "a spiral about the mean training camera, for forward-facing scenes",
    "cameras": "a smooth curve through the training cameras",
}
"""Paths of cameras -> meaning."""
