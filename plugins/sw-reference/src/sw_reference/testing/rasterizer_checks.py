"""Facts that hold for every rasterizer of 3DGS or 2DGS: closed forms, invariances, culling, broken inputs, scores.

A package tests its rasterizer with

    @pytest.mark.parametrize("check", checks_for(MyRasterizer.info), ids=str)
    def test_check(check):
        check(MyRasterizer(), "cpu")

and, for values and gradients on random scenes, `sw_reference.testing.raster_gradients`. A check is left out if it
needs a feature that the rasterizer does not declare. They run in float32.
"""

from __future__ import annotations

from splatwizard_core.api import RasterizerInfo
from sw_reference.testing import raster_closed_forms, raster_robustness, raster_scores, raster_surfels  # noqa: F401
from sw_reference.testing.facts import CHECKS, Check


def checks_for(info: RasterizerInfo) -> list[Check]:
    """Every check whose needs `info` declares, and that asks for what `info` cannot do without."""
    return [check for check in CHECKS if info.needs <= check.needs <= info.features]
