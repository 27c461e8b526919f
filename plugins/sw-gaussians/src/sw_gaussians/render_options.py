"""Render options stored in a model's file, which must be carried into the next file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from splatwizard_core.api import RasterOptions, SplatModel


def antialias_of(model: SplatModel) -> bool:
    """Return whether the model's file asks for Mip-Splatting's opacity compensation of the low-pass filter."""
    return _asked(model).get("antialias") is True


def eps2d_of(model: SplatModel) -> float:
    """Return the variance of the low-pass filter from the model's file, px^2; 0.3 if absent or invalid."""
    value = _asked(model).get("eps2d")
    return float(value) if type(value) in (int, float) and 0 <= value < math.inf else RasterOptions().eps2d


def raster_of(model: SplatModel) -> dict[str, Any]:
    """Return header values of a file by which the model is drawn as its own file asks for."""
    eps2d = eps2d_of(model)
    asked: dict[str, Any] = {"antialias": True} if antialias_of(model) else {}
    return {**asked, **({"eps2d": eps2d} if eps2d != RasterOptions().eps2d else {})}


def options_of(raster: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the header values of a file ask of a renderer."""
    return {key: raster[key] for key in ("antialias", "eps2d") if raster.get(key) is not None}


def lost_options(model: SplatModel) -> list[str]:
    """Describe the options that interchange formats cannot store; empty for most models."""
    eps2d = eps2d_of(model)
    return [] if eps2d == RasterOptions().eps2d else [f"its low-pass filter of {eps2d:g} px^2"]


def _asked(model: SplatModel) -> Mapping[str, Any]:
    found = getattr(model, "origin", {}).get("raster", {})
    return found if isinstance(found, Mapping) else {}
