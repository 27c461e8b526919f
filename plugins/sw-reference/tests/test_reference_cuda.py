"""The reference on a GPU: the same facts, and the float64 values of the CPU."""

import pytest
import torch
from sw_reference.rasterizer import ReferenceRasterizer
from sw_reference.testing.raster_gradients import GRADIENT_CASES, check_against
from sw_reference.testing.raster_scenes import RasterCase, cast_inputs, draw_scene
from sw_reference.testing.rasterizer_checks import checks_for

from splatwizard_core.api import RasterOptions

pytestmark = [
    pytest.mark.cuda,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU"),
]
REFERENCE = ReferenceRasterizer()


@pytest.mark.parametrize("check", checks_for(ReferenceRasterizer.info), ids=str)
def test_fact_on_cuda(check):
    check(REFERENCE, "cuda")


@pytest.mark.parametrize("case", GRADIENT_CASES, ids=lambda c: c.name)
def test_cuda_float32_equals_cpu_float64(case):
    check_against(REFERENCE, REFERENCE, case, device="cuda")


def test_results_stay_on_the_device():
    g, cam = draw_scene(RasterCase(), 0, torch.float32)
    result = REFERENCE.render(cast_inputs(g, device="cuda"), cam, RasterOptions(alpha=True))
    assert {x.device.type for x in (result.image, result.radii, result.alpha)} == {"cuda"}
