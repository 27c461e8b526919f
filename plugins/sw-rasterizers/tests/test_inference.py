"""What the approximate rasterizers say of themselves, where there is no GPU."""

from __future__ import annotations

import pytest
import torch
from sw_reference.testing.raster_scenes import RasterCase, draw_scene

from splatwizard_core.api import CapabilityError, RasterOptions
from splatwizard_core.tooling import NegotiatedRasterizer, load_plugins
from sw_rasterizers.inference import FlashRasterizer, TensorCoreRasterizer

KINDS = [FlashRasterizer, TensorCoreRasterizer]


@pytest.mark.parametrize("kind", KINDS, ids=lambda k: k.info.name)
def test_it_is_declared_as_approximate_and_without_gradients(kind):
    info = kind.info
    assert info.devices == {"cuda"}
    assert info.exactness.startswith("approx-")
    assert "UINT8_OUT" in info.features
    assert not info.features & {"BACKWARD", "DETERMINISTIC", "ABSGRAD", "FLOAT64"}
    assert info.min_cc == (8, 0)


@pytest.mark.parametrize("kind", KINDS, ids=lambda k: k.info.name)
def test_gaussians_of_the_cpu_are_refused(kind):
    g, cam = draw_scene(RasterCase(), 1, torch.float32)
    with torch.no_grad(), pytest.raises(CapabilityError, match="draws on cuda, the Gaussians are on cpu"):
        kind().render(g, cam, RasterOptions())


def test_on_the_cpu_an_accepted_approximation_changes_no_choice():
    rasterizer = NegotiatedRasterizer(load_plugins(), device="cpu", exactness=("exact", "approx-fp16", "approx-uint8"))
    with torch.no_grad():
        assert rasterizer.select([]).info.exactness == "exact"
        with pytest.raises(CapabilityError, match="UINT8_OUT"):
            rasterizer.select(["UINT8_OUT"])
