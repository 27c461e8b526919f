"""Options of drawing that came with a model: facts of its file, which the next file has to carry on."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from splatwizard_core.api import RasterOptions, SplatModel


def antialias_of(model: SplatModel) -> bool:
    """Return whether the file of a model asks for the opacity compensation of the low-pass filter (Mip-Splatting)."""
    return _asked(model).get("antialias") is True


def eps2d_of(model: SplatModel) -> float:
    """Return the low-pass filter that the file of a model asks for, px^2; 0.3 where it asks for none that is sound."""
    value = _asked(model).get("eps2d")
    return float(value) if type(value) in (int, float) and 0 <= value < math.inf else RasterOptions().eps2d


def lost_options(model: SplatModel) -> list[str]:
    """Name what no interchange format has a place for, in words; most models have nothing of the kind."""
    eps2d = eps2d_of(model)
    return [] if eps2d == RasterOptions().eps2d else [f"its low-pass filter of {eps2d:g} px^2"]


def _asked(model: SplatModel) -> Mapping[str, Any]:
    found = getattr(model, "origin", {}).get("raster", {})
    return found if isinstance(found, Mapping) else {}
