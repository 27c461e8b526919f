"""The compiled standard rasterizer against the pure-torch reference, finite differences and closed forms."""

from __future__ import annotations

import pytest
import torch
from sw_reference.rasterizer import ReferenceRasterizer
from sw_reference.testing.raster_gradients import GRADIENT_CASES, applies, check_against, check_gradients
from sw_reference.testing.rasterizer_checks import checks_for

from sw_rasterizers.native import MODULE
from sw_rasterizers.standard import StandardRasterizer

pytestmark = pytest.mark.skipif(MODULE.available() is not None, reason=str(MODULE.available()))
CASES = [case for case in GRADIENT_CASES if applies(case, StandardRasterizer.info)]


@pytest.fixture(autouse=True)
def _one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("check", checks_for(StandardRasterizer.info), ids=str)
def test_standard_rasterizer(check):
    check(StandardRasterizer())


@pytest.mark.parametrize("case", CASES, ids=lambda c: c.name)
def test_float64_gradients_are_the_derivatives(case):
    check_gradients(StandardRasterizer(), case)


@pytest.mark.parametrize("case", CASES, ids=lambda c: c.name)
@pytest.mark.parametrize("seed", [1, 2])
def test_float32_values_and_gradients_are_those_of_the_reference(case, seed):
    check_against(StandardRasterizer(), ReferenceRasterizer(), case, seed)
